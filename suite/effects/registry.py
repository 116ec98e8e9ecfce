"""Every kind of effect, in the order in which they are put into a model."""

from nerf2real.suite.effects.effect import Kind
from nerf2real.suite.effects.kinds import (
  actuation,
  backlash,
  camera,
  friction,
  ground,
  measurement,
  passive,
  residual,
)

# Order: constants first (errors of declared ones before additions; a gain that scales the damping
# before a friction that reads it), then forces and strength; backlash after all that changes the
# motor's torque; measurement chains from the sensor outwards.
_ORDER = (
  *passive.KINDS,
  *ground.KINDS,
  *(kind for kind in actuation.KINDS if kind.acts == "model"),
  *friction.KINDS,
  *(kind for kind in actuation.KINDS if kind.acts != "model"),
  *residual.KINDS,
  *backlash.KINDS,
  *measurement.KINDS,
  *camera.KINDS,
)

KINDS: dict[str, Kind] = {kind.name: kind for kind in _ORDER}

for _kind in _ORDER:
  _kind.operator.kind = _kind


def kind_of(name: str) -> Kind:
  """Returns the kind of that name; an unknown name is an error that lists the kinds."""
  if name not in KINDS:
    raise ValueError(f"Found the effect kind {name!r}, expected one of {sorted(KINDS)}.")
  return KINDS[name]
