"""The servo's law as entries of a report: what logs of duty show by themselves."""

import dataclasses
from typing import Any

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses.terms import SERVO_GAIN
from nerf2real.sysid.model.servo_law import ServoLaw
from nerf2real.sysid.selection.changes import Changed
from nerf2real.sysid.selection.findings import Identified

KIND = "motor_gain"


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


def apart(effects: list[Effect], claimed: list[dict[str, Any]]) -> list[Effect]:
  """Returns effects with the gains that are claimed as effects of their own, not as constants."""
  gains = {row["joint"]: row["parameters"]["gain"] for row in claimed}
  result: list[Effect] = []
  for effect in effects:
    gain = gains.get(effect.target) if effect.kind == "parameter_error" else None
    if gain is not None:
      value = gain["value"]
      samples = dict(effect.samples)
      if "gain" in samples:
        samples["gain"] = [v / value for v in samples["gain"]]
      bounds = dict(effect.intervals)
      if "gain" in bounds:
        bounds["gain"] = bounds["limit"]
      torque = float(effect.parameters["gain"]) / value  # type: ignore[arg-type]
      effect = effect.replace(gain=torque)
      effect = dataclasses.replace(effect, intervals=bounds, samples=samples)
    result.append(effect)
  for joint, gain in gains.items():
    result.append(
      Effect(KIND, joint, {"gain": gain["value"]}, {"gain": (gain["low"], gain["high"])})
    )
  return result


def notes(found: Identified) -> list[str]:
  """Returns a sentence a joint on its servo's law."""
  laws = ((item.joint, item.likelihood.law, item) for item in found.joints)
  return [_sentence(joint, law, item) for joint, law, item in laws if law is not None]


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


def _sentence(joint: str, law: ServoLaw, item: Changed) -> str:
  low, high = law.interval
  step = max(item.likelihood.floor[1], law.left)
  parts = [
    f"{law.gain:.3f} of the declared gain ({low:.3f} to {high:.3f})",
    f"{1e3 * law.delay:.0f} ms after the command",
    f"{100.0 * law.saturation:.0f} % of full duty at most",
  ]
  if law.dead_band > 0.0:
    parts.append(
      f"a dead band of {law.dead_band:.2g} {'rad' if item.likelihood.plant.hinge else 'm'}"
    )
  if law.wound > step:
    parts.append(f"an integral of {law.integral:.2g} 1/s")
  return (
    f"The duty of {joint} against its position error: {', '.join(parts)};"
    f" {100.0 * law.left:.2g} % of full duty is left (rms)."
  )
