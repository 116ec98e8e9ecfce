"""What the whole machine, simulated by MuJoCo, says of what was found joint by joint.

Joints are explained one at a time, among others that are prescribed as they were measured. An
effect that helps its joint there and makes the whole machine's error on the same logs worse
imitates what the others lack: it is not certain, and the extended model is better off without it.
"""

from collections.abc import Sequence
from typing import Any

from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.simulation import error, is_worse
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.settings import Settings


def discard_refuted(found: Identified, settings: Settings) -> None:
  """Takes out what makes the whole machine's error worse; joints that lose a name are unexplained.

  One part at a time, of those that the machine is better off without the one that is least certain,
  until all that are left help. A part is an effect that is claimed, or all else that a joint's fit
  brings along. Where courses do not repeat, windows that begin anew at the readings are compared:
  they refute what a fit brings along (a torque's scale, say, that no joint shows alone), but no
  claim of a joint that is judged by following, for they begin without knowing where its play lies.

  A single joint is the whole machine: its parts were fitted together, and go together where they
  leave more than the declared model does.

  Args:
    found: of a machine; changed.
    settings: length of windows where an actuator does not hold its position.
  """

  def left_by(effects: Sequence[Effect]) -> float:
    return error(
      found.model,
      found.logs,
      effects,
      clocks=found.clocks,
      window_s=settings.window_s,
      restart=bool(found.followed),
    )

  if len(found.joints) < 2:
    parts = [*found.calibration, *found.objects]
    judged = bool(parts) and not found.followed
    if judged and is_worse({"before": left_by([]), "after": left_by(parts)}):
      for effect in parts:
        _take_out(found, effect)
    return
  while True:
    whole, refuted = left_by([*found.calibration, *found.objects]), []
    for part in _parts(found):
      kept = [e for e in (*found.calibration, *found.objects) if not any(e is p for p in part)]
      without = left_by(kept)
      if is_worse({"before": without, "after": whole}):
        certain = max((_certainty(row) for e in part for row in _rows(found, e)), default=0.0)
        refuted.append((certain, without, part))
    if not refuted:
      return
    for effect in min(refuted, key=lambda item: item[:2])[2]:
      _take_out(found, effect)


def _parts(found: Identified) -> list[list[Effect]]:
  """Returns the effects that may be taken out: every claimed one, and each joint's others."""
  followed = [j.joint for j in found.followed]
  parts: dict[object, list[Effect]] = {}
  for effect in (*found.calibration, *found.objects):
    claimed = bool(rows := _rows(found, effect))
    if not any(row["joint"] in followed for row in rows):
      parts.setdefault(id(effect) if claimed else effect.target, []).append(effect)
  return list(parts.values())


def _rows(found: Identified, effect: Effect) -> list[dict[str, Any]]:
  """Returns the entries that claim an effect."""
  return [
    row
    for row in found.effects
    if row["kind"] == effect.kind and row.get("body", row["joint"]) == effect.target
  ]


def _certainty(row: dict[str, Any]) -> float:
  return float(row["evidence"].get("clear_by_standard_errors") or 0.0)


def _take_out(found: Identified, effect: Effect) -> None:
  """Takes an effect out of the extended model and of what is claimed."""
  lost = _rows(found, effect)
  found.calibration[:] = [e for e in found.calibration if e is not effect]
  found.objects[:] = [e for e in found.objects if e is not effect]
  found.effects[:] = [row for row in found.effects if not any(row is other for other in lost)]
  found.nearest += lost
  claimed = [row["joint"] for row in lost]  # of a payload: its target is a body
  for item in found.joints:
    if effect.target in (item.joint, None) or item.joint in claimed:
      item.elaborated = []
    if item.joint in claimed and item.verdict in ("effects", "partly"):
      item.verdict = "unexplained"
