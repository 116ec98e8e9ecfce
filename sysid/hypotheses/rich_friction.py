"""Dry friction under load with its square and its fall from rest: a gear's, beyond the library.

Gears under load rub more than in proportion to it, and hold at rest more than they take in motion:

    (coefficient |L| + quadratic L^2) (1 + rest exp(-(v / velocity)^2))

Source: Duclusaud, Passault, Padois and Ly 2024, "Extended friction models for the physics
simulation of servo actuators", whose models of load, square and Stribeck this joins in one factor.
Four values imitate much, so that it makes predictions better and is no ground for a name.
"""

from nerf2real.sysid.hypotheses.candidates import typical_speed, typical_torque
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.plant import JointPlant

FORMS = (0, 1, 2, 3, 4)
"""Which torque L loads the gear: `suite.effects.kinds.friction.LoadFriction`."""
REPLACED = ("load_friction", "stribeck_friction", "supply_sag")
"""Kinds that imitate parts of it: strength that falls with torque is like friction that grows."""

_SLOWEST = 0.1
"""Of the fastest speed, most that the fall from rest to motion may take: the authors' published
fits of small servos have 0.07 to 0.11 rad/s; chosen, some times that."""
_EXPECTED = {"coefficient": 0.1, "rest": 0.5}
"""Spread about zero: what a motion does not show stays away; chosen."""


def rich_friction(plant: JointPlant, carried: int) -> Term:
  """Returns the friction as a term.

  Args:
    plant: the joint.
    carried: which torque loads the gear.
  """
  fast, large = typical_speed(plant), typical_torque(plant)
  names = ("coefficient", "quadratic", "rest", "velocity")
  return Term(
    "load_friction",
    plant.joint,
    names,
    (0.0, 0.0, 0.0, 0.002 * fast),
    (0.8, 3.0 / large, 3.0, _SLOWEST * fast),
    (0.1, 0.2 / large, 0.2, 0.05 * fast),
    ((0.1, 0.3 / large, 0.4, 0.1 * fast), (0.05, 1.0 / large, 0.4, 0.03 * fast)),
    tuple(_EXPECTED.get(name, float("inf")) for name in names),
    (0.0,) * len(names),
    fixed=(("carried", float(carried)),),
  )
