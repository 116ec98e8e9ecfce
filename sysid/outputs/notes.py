"""Sentences of a report that follow from what was found."""

from typing import Any

from nerf2real.sysid.selection.joints.changed import Changed
from nerf2real.sysid.settings import SETTINGS


def of_one(row: dict[str, Any]) -> str:
  """Returns a sentence on an effect of several joints that may be of one alone."""
  return (
    f"These logs do not tell whether {row['kind']} is of all joints or of {row['joint']} alone,"
    f" which is behind by {row['evidence']['behind_by_standard_errors']:.1f} standard errors."
  )


def another_session(item: Changed) -> list[str]:
  """Returns a sentence on what a reference of another session cannot show."""
  if not (item.subject.paired and item.subject.another_session):
    return []
  friction = dict(SETTINGS.another_session)["friction"]
  return [
    f"The reference of {item.joint} is of another session, and a machine's constants differ from"
    f" one to the next (friction by {100 * friction:.0f} %): differences no larger than that makes"
    " are taken for nothing. A reference of the same hour shows smaller ones."
  ]


def spread(error: dict[str, Any]) -> str:
  """Returns a sentence on the errors of fits near the best."""
  name = "held" if error["held"] else "train"
  found = error[name]
  return (
    f"Errors after are of the mean of {found['models']} fits near the best, which differ:"
    f" {found['median']:.3g} rad (or m) in the median, {found['least']:.3g} to {found['most']:.3g}"
    f" on the {name} logs; the model that is written alone has {found['single']:.3g}."
  )
