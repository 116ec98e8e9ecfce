"""From the terms of a hypothesis to the kernel's parameters and loads of one joint."""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel, Load

Array = np.ndarray


def compose(plant: JointModel, terms: Sequence[Term], x: Array) -> tuple[Array, list[Load]]:
  """Returns kernel parameters [P] and loads of terms with values x [n]."""
  p, loads, at = plant.declared.copy(), [], 0
  for term in terms:
    part = x[at : at + len(term.names)]
    at += len(term.names)
    term.apply(plant, p, part)
    values = dict(zip(term.names, map(float, part), strict=True)) | dict(term.fixed)
    if term.kind == "payload":
      m, a, b, c = (values[n] for n in ("mass", "x", "y", "z"))
      moments = m * np.array([1, a, b, c, a * a, b * b, c * c, a * b, a * c, b * c])
      loads.append(Load(str(term.target), moments))
    elif term.kind == "gravity_tilt":
      loads.append(plant.tilt_load(values["x"], values["y"]))
    elif term.kind == "calibration" and "mass" in values:
      loads.append(Load("mass", np.array([values["mass"]])))
  return p, loads
