"""What the findings rest on, and what is simulated with."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf2real.core.serialization import to_plain
from nerf2real.suite.effects import Effect
from nerf2real.sysid.data.opening import load_model
from nerf2real.sysid.drift import stored
from nerf2real.sysid.fit import whitening
from nerf2real.sysid.model.simulation import Member
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.sensors import sensing


def details_of(
  found: Identified, model: Path, near: Sequence[Member], sensed: sensing.Sensed
) -> dict[str, Any]:
  """Returns what the findings rest on, and what the extended model is simulated with."""
  first = found.least_explained
  return {
    "model": str(model.resolve()),
    **stored.model_marks(model, load_model(model)),
    **stored.member_to_json(near[0]),
    "near": [stored.member_to_json(member) for member in near[1:]],
    "calibration": {
      e.target: {n: round(float(v), 5) for n, v in e.parameters.items()}  # type: ignore[arg-type]
      for e in found.calibration
    },
    "tests": {
      "joint": first.joint,
      **{
        name: whitening.tests(first.likelihood, item.fit.residuals[0][0])
        for name, item in (("declared", first.declared), ("extended", first.extended))
      },
    },
    "audit": found.audits,
    "servo": {j.joint: to_plain(j.likelihood.law) for j in found.joints if j.likelihood.law},
    "sensors": sensed.errors(),
  }


def claimed_effects(found: Identified) -> list[Effect]:
  """Returns the effects that go into effects.json.

  The constants of a joint go with its effects, which were fitted beside them.
  """
  if found.verdict == "none":
    return []
  joints = {e["joint"] for e in (*found.effects, *found.nearest)}
  all_off = any(e["kind"] == "parameter_error" and e["joint"] is None for e in found.effects)
  constants = [c for c in found.calibration if all_off or c.target in joints]
  return [*constants, *found.objects]
