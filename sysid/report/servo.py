"""The servo's law as entries of a report: what logs of duty show by themselves."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses.terms import SERVO_GAIN
from nerf2real.sysid.model.servo.law import ServoLaw
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joints.changes import Changed

KIND = "motor_gain"
_SEVERAL = 3  # joints from which their laws are told in one sentence


def rows(found: Identified) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
  """Returns gains that are off the declared ones by the duty alone, as entries of what is claimed
  and of what a reference shows, too."""
  claimed: list[dict[str, Any]] = []
  before: list[dict[str, Any]] = []
  for item in found.joints:
    law = _constant(item)
    if law is not None:
      (claimed if item.subject.before is None else before).append(_row(item.joint, law))
  return claimed, before


def by_law(row: Mapping[str, Any]) -> bool:
  """Tells whether an entry is the gain of the servo's law, which the constants hold, too."""
  return bool(row["evidence"].get("servo_law", False))


def apart(effects: list[Effect], claimed: list[dict[str, Any]]) -> list[Effect]:
  """Returns effects with the gains that are claimed as effects of their own, not as constants.

  A joint has one effect of a kind: where its torque at a duty is off, too, which is a gain that
  scales the limit, the duty's gain stays among the constants. So it does beside one of all joints.
  """
  weak = {effect.target for effect in effects if effect.kind == KIND}
  if None in weak:
    return list(effects)
  gains = {row["joint"]: row["parameters"]["gain"] for row in claimed if row["joint"] not in weak}
  result: list[Effect] = []
  for effect in effects:
    gain = gains.get(effect.target) if effect.kind == "parameter_error" else None
    if gain is not None:
      value = gain["value"]
      samples = {
        name: [v / value for v in row] if name == "gain" else row
        for name, row in effect.samples.items()
      }
      torque = float(effect.parameters["gain"]) / value  # type: ignore[arg-type]
      bounds = dict(effect.intervals)
      if "gain" in bounds:
        bounds["gain"] = bounds["gain"][0] / value, bounds["gain"][1] / value
      effect = effect.replace(gain=torque)
      effect = dataclasses.replace(effect, intervals=bounds, samples=samples)
    result.append(effect)
  for joint, gain in gains.items():
    result.append(
      Effect(KIND, joint, {"gain": gain["value"]}, {"gain": (gain["low"], gain["high"])})
    )
  return result


def notes(found: Identified) -> list[str]:
  """Returns a sentence a joint on its servo's law; one for joints whose laws are no more than a
  gain and a delay, where there are several."""
  laws = [(i.joint, i.likelihood.law, i) for i in found.joints if i.likelihood.law is not None]
  plain = [law for _, law, item in laws if not (law.dead_band or _winds(law, item))]
  if len(plain) < _SEVERAL:
    return [_sentence(*row) for row in laws]
  rest = [_sentence(*row) for row in laws if not any(row[1] is law for law in plain)]
  return [_together(plain), *rest]


def _constant(item: Changed) -> ServoLaw | None:
  """Returns the law whose gain is in a joint's constants, if that is off the declared one."""
  held = {name for term in item.known for name, _ in term.fixed}
  likelihood = item.subject.before or item.likelihood
  return likelihood.law if SERVO_GAIN in held else None


def _row(joint: str, law: ServoLaw) -> dict[str, Any]:
  low, high = law.interval
  gain = {"value": law.gain, "low": low, "high": high, "unit": "1"}
  evidence = {
    "clear_by_standard_errors": round(min(abs(law.gain - 1.0) / law.gain_deviation, 999.0), 2),
    "servo_law": True,
  }
  return {"kind": KIND, "joint": joint, "parameters": {"gain": gain}, "evidence": evidence}


def _winds(law: ServoLaw, item: Changed) -> bool:
  """Tells whether an integral makes more of the duty than its steps and what is left."""
  return law.wound > max(item.likelihood.floor[1], law.left)


def _together(laws: list[ServoLaw]) -> str:
  def span(values: list[float], digits: str) -> str:
    ends = [format(value, digits) for value in (min(values), max(values))]
    return " to ".join(dict.fromkeys(ends))

  return (
    f"The duty of {len(laws)} joints against their position errors:"
    f" {span([law.gain for law in laws], '.3f')} of the declared gain,"
    f" {span([1e3 * law.delay for law in laws], '.0f')} ms after the command;"
    f" {span([100.0 * law.left for law in laws], '.2g')} % of full duty is left (rms)."
  )


def _sentence(joint: str, law: ServoLaw, item: Changed) -> str:
  low, high = law.interval
  parts = [
    f"{law.gain:.3f} of the declared gain ({low:.3f} to {high:.3f})",
    f"{1e3 * law.delay:.0f} ms after the command",
    f"{100.0 * law.saturation:.0f} % of full duty at most",
  ]
  if law.rate:
    parts.append(f"by a clock of the readings that gains {1e3 * law.rate:.1f} ms a second")
  if law.dead_band > 0.0:
    parts.append(
      f"a dead band of {law.dead_band:.2g} {'rad' if item.likelihood.plant.hinge else 'm'}"
    )
  if _winds(law, item):
    parts.append(f"an integral of {law.integral:.2g} 1/s")
  return (
    f"The duty of {joint} against its position error: {', '.join(parts)};"
    f" {100.0 * law.left:.2g} % of full duty is left (rms)."
  )
