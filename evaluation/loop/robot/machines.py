"""The virtual robot of a loop, with undeclared effects in it."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from nerf2real.real.loading import Connection
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.real.virtual.undeclared import Undeclared

DRAWN = "drawn"


def hidden_effects(texts: Sequence[str], seed: int) -> tuple[Undeclared, ...]:
  """Returns the undeclared effects of a command line; "drawn" draws them from the seed.

  Raises:
    ValueError: A text is no effect.
  """
  drawn = [effect for text in texts if text == DRAWN for effect in undeclared.draw(seed)]
  return (*drawn, *undeclared.parse_all(text for text in texts if text != DRAWN))


@contextlib.contextmanager
def virtual_robot(
  seed: int, altered: Sequence[Undeclared] = (), *, films: bool = False, age: float = 0.0
) -> Iterator[tuple[Connection, VirtualRobot]]:
  """Yields a virtual robot on stepped time and how it is reached.

  Args:
    seed: Of its own build.
    altered: Undeclared effects that it has besides.
    films: Whether it has a camera, in the true room; else it stands on a bare floor.
    age: Time that its battery was in use before [s].
  """
  build = undeclared.build(seed, altered, age=age)
  world: dict[str, Any] = {"world": "room", "camera": build.camera} if films else {}
  with VirtualRobot(stepped=True, seed=seed, hidden=build.hidden, **world) as robot:
    yield robot.connection(), robot
