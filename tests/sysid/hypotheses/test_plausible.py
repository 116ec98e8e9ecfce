"""How far effects are looked for: a payload where what a body holds can have it."""

import mujoco
import pytest

from nerf2real.sysid.hypotheses.candidates import cogging, library, strongest
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.model.joint import JointModel
from tests.sysid.synthetic import ARM, log_of

HAND = """<body name="hand" pos="0 0 -0.15"><inertial pos="0 0 -0.05" mass="0.2"
  diaginertia="1e-4 1e-4 1e-4"/></body>"""
HOLDING = ARM.replace("    </body>\n  </body>", f"    {HAND}</body>\n  </body>")
STRONG = HOLDING.replace('forcerange="-4 4"', 'forcerange="-80 80"')


def bounds(xml, joint):
  """Returns how far from its body's frame a payload of a joint is looked for, m, and its prior."""
  model = mujoco.MjModel.from_xml_string(xml)
  plant = JointModel(model, joint, [log_of(xml, "sweep", duration=2.0)])
  (term,) = (plausible(t, plant) for t in library(plant) if t.kind == "payload")
  return term.high[3], term.prior[3]


def test_a_hand_holds_a_payload_beyond_itself():
  assert HOLDING != ARM
  reach, prior = bounds(STRONG, "elbow")
  assert reach == pytest.approx(2.5 * 0.2) and prior == pytest.approx(0.2)
  assert bounds(HOLDING, "elbow")[0] == pytest.approx(0.25 * (4 / 2.5) ** 0.25)


def test_what_another_joint_moves_is_not_held():
  assert bounds(HOLDING, "shoulder") == bounds(ARM, "shoulder")


def test_torque_that_holds_a_joint_is_looked_for_up_to_what_moves_it():
  """A wave that ended at half the usual torque left the rest of a larger one to a weak motor."""
  model = mujoco.MjModel.from_xml_string(ARM)
  plant = JointModel(model, "elbow", [log_of(ARM, "sweep", duration=2.0)])
  terms = {t.kind: t for t in (*library(plant), cogging(plant, [(0.1, 14.0, 0.0)]))}
  kinds = ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "cogging")
  assert [terms[kind].high[0] for kind in kinds] == [strongest(plant)] * len(kinds)
