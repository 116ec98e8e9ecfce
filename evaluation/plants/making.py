"""Makes the plant that the settings of an evaluation name; each kind imports what it needs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf2real.agents.environments.loading import camera_settings
from nerf2real.evaluation.plants import swaps
from nerf2real.evaluation.plants.plant import Plant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual.undeclared import Undeclared


def make_plant(
  settings: EvaluationSettings,
  scene: Any,
  image_size: tuple[int, int] | None,
  *,
  trained_on: str = "",
  record: Path | None = None,
  draw_effects: bool = False,
  altered: Sequence[Undeclared] = (),
  session: float = 0.0,
) -> Plant:
  """Returns the plant that the settings of one name; see `session.each_plant`.

  Args:
    settings: The evaluation.
    scene: An opened bundle.
    image_size: Height and width of the policy's picture; None for no camera.
    trained_on: Name of the policy's environment: a simulated camera has its rate, lens and
      response. Robots have cameras of their own, but for what is swapped.
    record: Where a run on a robot is recorded; not recorded if None.
    draw_effects: Whether every episode in simulation draws the effects from their intervals.
    altered: Undeclared effects of the virtual robot.
    session: Time that the virtual robot's battery was in use before [s].
  """
  swaps.check(settings.swap, plant=settings.plant, built_in=settings.scene is None)
  camera = camera_settings(trained_on)
  if settings.plant == "sim":
    from nerf2real.evaluation.plants.simulated import SimulatedPlant

    return SimulatedPlant(
      scene,
      settings,
      image_size=image_size,
      camera=camera,
      draw_effects=draw_effects,
    )
  if settings.plant == "virtual":
    from nerf2real.evaluation.plants.rehearsed import RehearsedPlant

    return RehearsedPlant(
      scene,
      settings,
      image_size=image_size,
      simulated=camera,
      altered=altered,
      session=session,
      record=record,
    )
  from nerf2real.evaluation.plants.operated import OperatedPlant

  return OperatedPlant(scene, settings, image_size=image_size, record=record)


def free_name(path: Path) -> Path:
  """Returns the path, or one with a number behind it if that is taken."""
  number = 1
  found = path
  while found.exists():
    number += 1
    found = path.with_stem(f"{path.stem}_{number}")
  return found
