"""Policies by name: the scripted walker, the policy that is shipped, or a folder."""

from pathlib import Path

from nerf2real import agents
from nerf2real.agents.dmpo.policy.export import RECORD, read_record
from nerf2real.suite.tasks import catalogue
from nerf2real.suite.views.drivers import WALKER

SHIPPED = "shipped"
WALKERS = (WALKER, "gait")  # the second is its name in records
_IN_A_RUN = ("policy/best", "policy/newest")


def shipped_folder(task: str, variant: str = "") -> Path:
  """Returns where a policy of a task is shipped, whether there is one or not.

  Args:
    task: The task.
    variant: Of its policies: "" for its first, "60x80" for one of such pictures.
  """
  return Path(agents.__path__[0]) / "policies" / (f"{task}_{variant}" if variant else task)


def policy_folder(name: str, *, task: str) -> Path:
  """Returns the folder of an exported policy.

  Args:
    name: "shipped", "shipped_60x80", a run's folder (its best policy, or else its newest one is
      taken), or an exported policy's folder.
    task: The task that it is to act in.

  Raises:
    ValueError: There is no such policy, or it was trained on another of the suite's tasks.
  """
  folder = _find(name, task=task)
  trained_on = str(read_record(folder)["environment"]).partition("?")[0].removeprefix("suite:")
  if trained_on in catalogue.ALL_TASKS and trained_on != task:
    raise ValueError(
      f"The policy {folder} was trained on {trained_on}, found the task {task}: take one of that "
      "task."
    )
  return folder


def _find(name: str, *, task: str) -> Path:
  shipped, _, variant = name.partition("_")
  if shipped == SHIPPED:
    folder = shipped_folder(task, variant)
    if not (folder / RECORD).is_file():
      raise ValueError(
        f"No policy {name} for {task} comes with this version (expected one in {folder}): use "
        f"--policy {WALKER}, or the folder of a run."
      )
    return folder
  for folder in (Path(name), *(Path(name) / inner for inner in _IN_A_RUN)):
    if (folder / RECORD).is_file():
      return folder
  raise ValueError(
    f"Unknown policy {name!r}: expected {WALKER}, {SHIPPED}, or a folder that holds {RECORD} (of "
    f"an exported policy) or {_IN_A_RUN[0]} (of a run)."
  )
