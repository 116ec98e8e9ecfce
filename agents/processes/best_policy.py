"""Selects the best policy of a run from its evaluations."""

import math
from collections.abc import Mapping
from typing import Any


class BestPolicy:
  """The best evaluation so far: by success on fresh trials, or by return where none is known.

  Where a task has success, an evaluation that looks best is repeated on fresh trials
  (`confirmation`), and these alone count: the maximum of noisy figures is biased.
  """

  def __init__(self, info: Mapping[str, Any]):
    """Begins with what `record` gave a checkpoint, or with nothing."""
    best = info.get("best_return")
    self.best_return: float = -math.inf if best is None else best
    self.success: float | None = info.get("best_success")
    self.evaluated: float | None = None  # last mean return that was no confirmation

  def take(self, values: Mapping[str, Any], *, is_held: bool) -> bool:
    """Takes an evaluation in; returns whether its policy is the best so far.

    Args:
      values: the evaluator's figures.
      is_held: whether the policy's parameters are here; one that cannot be kept is no best.
    """
    result, version = values.get("return"), values.get("version")
    if not isinstance(result, int | float) or not isinstance(version, int):
      return False
    success = values.get("success")
    if not isinstance(success, int | float):
      better, success = result > self.best_return, None
    else:
      best = -1.0 if self.success is None else self.success
      better = bool(values.get("confirmation")) and (success, result) > (best, self.best_return)
    if not values.get("confirmation"):
      self.evaluated = float(result)
    better = better and is_held
    if better:
      self.best_return, self.success = float(result), success
    return better

  def record(self) -> dict[str, Any]:
    """Returns what a checkpoint keeps."""
    finite = math.isfinite(self.best_return)
    return {"best_return": self.best_return if finite else None, "best_success": self.success}
