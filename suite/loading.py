"""Builds an environment from a task's name and a scene bundle."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerf2real.core import errors
from nerf2real.suite.effects import Effect, read_effects
from nerf2real.suite.environment import Environment
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.registry import find_task
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import CameraSettings, FieldRenderer, RobotCamera
from nerf2real.suite.tasks.settings import PHYSICS_TIMESTEP, TaskSettings

if TYPE_CHECKING:
  from nerf2real.scenes.field.render.renderer import Renderer


def load(
  task: str,
  *,
  scene: Any = None,
  effects: Any = None,
  draw_effects: bool = False,
  image_size: tuple[int, int] | None = (30, 40),
  random: Any = None,
  camera: CameraSettings | None = None,
  randomisation: RandomisationSettings | None = None,
  privileged: bool = True,
  time_limit: float | None = None,
  physics_timestep: float = PHYSICS_TIMESTEP,
  renderer: FieldRenderer | None = None,
  furnish: Callable[[Any], None] | None = None,
  surface: bool = False,
) -> Environment:
  """Loads a task in a scene.

  Args:
    task: "nerf_nav", "ball_push", or one that was registered; `suite.known_tasks` lists them.
    scene: Folder of a scene bundle, or an opened `scenes.bundle.Bundle`; None is the built-in room.
    effects: An `effects.json`, an effect or a sequence of effects: what the nominal model lacks.
    draw_effects: Whether every episode draws the effects' values from their intervals.
    image_size: (height, width) of the robot's camera; None for an environment without pictures.
    random: A seed or `np.random.RandomState`: the same seed gives the same episodes.
    camera: Settings of the robot's camera.
    randomisation: Which parts of an episode are random; all of them if None.
    privileged: Whether to give the observations that only the critic may see.
    time_limit: Length of an episode [s]; the task's own if None.
    physics_timestep: s.
    renderer: Renders the scene instead of the bundle's field, in the bundle's unit frame.
    furnish: Called with the arena's MJCF model before it is compiled, to put things into it. The
      robot's camera sees geoms of group 0, MuJoCo's own, on bodies that have a joint or are mocap;
      what is fixed to the world is taken for a part of the scene, which the field shows: it
      collides unseen.
    surface: Whether the model holds the room's coloured surface mesh, so that `physics.render()`
      and MuJoCo's own viewers show the room; see suite/README.md for what it costs.

  Returns:
    The environment, a `composer.Environment`.

  Raises:
    ValueError: If an argument is none of what is expected; the message lists what is.
  """
  found = find_task(task)
  camera = camera or CameraSettings()
  lens = None if image_size is None else camera.camera(image_size)
  bundle = open_scene(scene)
  robot_camera = None
  if lens is not None:
    robot_camera = RobotCamera(
      renderer or load_renderer(bundle),
      lens,
      world_from_unit=bundle.world_from_unit,
      settings=camera,
    )
  settings = TaskSettings(
    time_limit=found.time_limit if time_limit is None else time_limit,
    physics_timestep=physics_timestep,
    privileged=privileged,
    randomisation=randomisation or RandomisationSettings(),
    effects=_effects(effects),
    draw_effects=draw_effects,
  )
  built = found.task(bundle, camera=robot_camera, settings=settings)
  if surface:
    from nerf2real.suite.surface import add_surface

    add_surface(built.root_entity.mjcf_model, Path(bundle.visual_path))
  if furnish is not None:
    furnish(built.root_entity.mjcf_model)
  try:
    return Environment(built, time_limit=settings.time_limit, random_state=random)
  except ValueError as error:
    raise ValueError(errors.not_compiled(error, getattr(bundle, "folder", "the scene"))) from error


def _effects(effects: Any) -> tuple[Effect, ...]:
  """Returns effects from a file, a sequence or one alone."""
  if isinstance(effects, str | Path):
    return tuple(read_effects(effects))
  listed = () if effects is None else effects
  found = tuple(listed) if isinstance(listed, Iterable) else (listed,)
  for effect in found:
    if not isinstance(effect, Effect):
      raise ValueError(
        f"effects must be an effects.json or a sequence of suite.effects.Effect, found {effect!r}."
      )
  return found


def load_renderer(bundle: Any) -> "Renderer":
  """Returns a renderer of a bundle's field on this machine's CPU."""
  from nerf2real.scenes.field.field import Field
  from nerf2real.scenes.field.render.renderer import Renderer

  return Renderer(Field.load(bundle.field_path))
