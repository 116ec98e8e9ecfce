"""Tasks by name: the two of the paper, those that were registered, those of other packages.

Another package offers tasks as entry points of the group `nerf2real.tasks`:

  [options.entry_points]
  nerf2real.tasks =
    fetch = my_package.fetch:Fetch

Nothing of a task is imported before it is loaded.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, NamedTuple

from nerf2real.core import errors
from nerf2real.suite.tasks.catalogue import ALL_TASKS, BALL_PUSH, NERF_NAV, TIME_LIMITS

if TYPE_CHECKING:
  from nerf2real.suite.tasks.base import RobotTask

GROUP = "nerf2real.tasks"
_OWN = {
  NERF_NAV: "nerf2real.suite.tasks.nerf_nav:NerfNav",
  BALL_PUSH: "nerf2real.suite.tasks.ball_push:BallPush",
}
_registered: "dict[str, TaskEntry]" = {}


class TaskEntry(NamedTuple):
  """A task that can be loaded."""

  task: "type[RobotTask] | str"  # the class, or "module:Class"
  time_limit: float | None  # s; None: the class's own `time_limit`


class LoadedTask(NamedTuple):
  """A task's class and the length of its episodes."""

  task: "type[RobotTask]"
  time_limit: float  # s


def register_task(
  name: str, task: "type[RobotTask] | str", *, time_limit: float | None = None
) -> None:
  """Registers a task for `suite.load`; a name that was registered before gets another task.

  Args:
    name: The name.
    task: A subclass of `suite.tasks.base.RobotTask` whose constructor takes (scene, *, camera,
      settings), or its place as "module:Class", which is imported when it is loaded.
    time_limit: Length of an episode [s]; the class's attribute `time_limit` if None.

  Raises:
    ValueError: The name is one of the paper's tasks.
  """
  if name in _OWN:
    raise ValueError(f"{name!r} is one of the suite's own tasks: register yours by another name.")
  _registered[name] = TaskEntry(task, time_limit)


def known_tasks() -> tuple[str, ...]:
  """Returns the names of all tasks that `suite.load` finds."""
  return (*ALL_TASKS, *sorted({*_registered, *_offered()} - set(ALL_TASKS)))


def find_task(name: str) -> LoadedTask:
  """Returns a task's class, imported now.

  Raises:
    ValueError: There is no such task, or no length of its episodes.
  """
  entries = {key: TaskEntry(place, TIME_LIMITS[key]) for key, place in _OWN.items()}
  entry = (_offered() | _registered | entries).get(name)
  if entry is None:
    raise ValueError(errors.unknown_name("task", name, known_tasks()))
  task = entry.task
  if isinstance(task, str):
    module, _, attribute = task.partition(":")
    task = getattr(importlib.import_module(module), attribute)
  limit = entry.time_limit if entry.time_limit is not None else getattr(task, "time_limit", None)
  if limit is None:
    raise ValueError(
      f"Task {name!r} has no length of its episodes: give {task.__name__} an attribute time_limit "
      "[s], or register it with one."
    )
  return LoadedTask(task, float(limit))


def _offered() -> dict[str, TaskEntry]:
  """Tasks of other packages."""
  points = importlib.metadata.entry_points(group=GROUP)
  return {point.name: TaskEntry(point.value, None) for point in points}
