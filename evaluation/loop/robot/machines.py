"""The virtual robot of a loop, with undeclared effects in it."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core import files
from nerf2real.evaluation.loop.robot.motions import TRAIN
from nerf2real.real.loading import Connection
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.real.virtual.undeclared import Undeclared

DRAWN = "drawn"
_MOMENT = 0.1  # s; chosen: more than a period of control, bus and camera


def hidden_effects(texts: Sequence[str], seed: int) -> tuple[Undeclared, ...]:
  """Returns the undeclared effects of a command line; "drawn" draws them from the seed.

  Raises:
    ValueError: A text is no effect.
  """
  drawn = [effect for text in texts if text == DRAWN for effect in undeclared.draw(seed)]
  return (*drawn, *undeclared.parse_all(text for text in texts if text != DRAWN))


def noise_beside(reference: Path | None) -> int:
  """Returns the noise of a recording beside a reference's, for `virtual_robot`; 0 without one.

  The number is of the reference's first log, so that the same command records the same again, and
  not the number that the reference was recorded with: beside a robot that repeats its noise to the
  bit, nothing but what is hidden would differ.

  Args:
    reference: Folder of its logs.
  """
  return 0 if reference is None else int(files.hash_path(reference / f"{TRAIN[0]}.mcap")[:8], 16)


@contextlib.contextmanager
def virtual_robot(
  seed: int,
  altered: Sequence[Undeclared] = (),
  *,
  films: bool = False,
  age: float = 0.0,
  noise: int = 0,
) -> Iterator[tuple[Connection, VirtualRobot]]:
  """Yields a virtual robot on stepped time and how it is reached.

  Args:
    seed: Of its own build.
    altered: Undeclared effects that it has besides.
    films: Whether it has a camera, in the true room; else it stands on a bare floor.
    age: Time that its battery was in use before [s].
    noise: Another number is another recording of the same robot: other noise of its sensors, and
      switched on at another moment between the steps of plant, bus and camera. Without both the
      robot repeats its motions to the bit.
  """
  build = undeclared.build(seed, altered, age=age)
  world: dict[str, Any] = {"world": "room", "camera": build.camera} if films else {}
  with VirtualRobot(stepped=True, seed=seed, hidden=build.hidden, noise=noise, **world) as robot:
    moment = np.random.default_rng([seed, 8, noise]).uniform(0.0, _MOMENT)
    robot.clock.sleep_until(robot.clock.now() + (moment if noise else 0.0))
    yield robot.connection(), robot
