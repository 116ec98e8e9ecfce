"""Policies by name: the scripted walker, the policy that is shipped, or a folder."""

from pathlib import Path

from nerf2real import agents
from nerf2real.suite.views.drivers import WALKER

SHIPPED = "shipped"
WALKERS = (WALKER, "gait")  # the second is its name in records
_RECORD = "policy.json"
_IN_A_RUN = ("policy/best", "policy/newest")


def shipped_folder(task: str) -> Path:
  """Returns where the policy of a task is shipped, whether there is one or not."""
  return Path(agents.__path__[0]) / "policies" / task


def policy_folder(name: str, *, task: str) -> Path:
  """Returns the folder of an exported policy.

  Args:
    name: "shipped", a run's folder (its best policy, or else its newest one is taken), or an
      exported policy's folder.
    task: The task, for the shipped one.

  Raises:
    ValueError: There is no such policy; the message is one line.
  """
  if name == SHIPPED:
    folder = shipped_folder(task)
    if not (folder / _RECORD).is_file():
      raise ValueError(
        f"No policy for {task} is shipped with this version (expected one in {folder}): use "
        f"--policy {WALKER}, or the folder of a run."
      )
    return folder
  for folder in (Path(name), *(Path(name) / inner for inner in _IN_A_RUN)):
    if (folder / _RECORD).is_file():
      return folder
  raise ValueError(
    f"Unknown policy {name!r}: expected {WALKER}, {SHIPPED}, or a folder that holds {_RECORD} (of "
    f"an exported policy) or {_IN_A_RUN[0]} (of a run)."
  )
