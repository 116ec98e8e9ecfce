"""Constants that are off, where no reference shows them and where one does."""

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.joints import reference
from nerf2real.sysid.selection.joints.baseline import (
  changed_constants,
  differs,
  known_terms,
  widened,
)
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of


def test_all_torques_are_not_larger_by_a_factor_that_no_motion_shows():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  own = constants(JointModel(model, "joint", [log_of(PENDULUM, "sweep", duration=5.0)]))
  tight, freed = (dict(zip(own.names, t.prior, strict=True)) for t in (own, widened(own)))
  assert freed["gain"] == tight["gain"]
  assert freed["damping"] > 2.0 * tight["damping"]


@pytest.mark.parametrize(
  "strength, mass, limit", [(1.3, 1.0, 4.0), (1.0, 1.3, 4.0), (1.0, 1.0, 5.2)]
)
def test_a_reference_tells_the_ratios_of_torques_and_masses(strength, mass, limit):
  """Gain and damping are larger by one factor, or the mass is, or the largest torque: the others
  are as declared. That all torques are larger no motion shows, but tolerances do: masses are known
  better than servos."""
  machine = PENDULUM.replace('kp="21"', f'kp="{21 * strength}"')
  machine = machine.replace('damping="1.0"', f'damping="{strength}"')
  machine = machine.replace('mass="0.5"', f'mass="{0.5 * mass}"')
  machine = machine.replace('"-4 4"', f'"{-limit} {limit}"')
  logs = [log_of(machine, kind, duration=6.0) for kind in ("sweep", "slow", "steps")]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  usual = reference.reference_constants(JointLikelihood(plant, settings=SETTINGS), SETTINGS)
  values = usual.fit.values(usual.terms[0])
  gain, heavier = 1.0 + values["gain"], 1.0 + values["mass"]
  assert gain / heavier == pytest.approx(strength / mass, rel=0.03)
  assert 4.0 * (1.0 + values["limit"]) == pytest.approx(limit / strength, rel=0.05)
  if mass == 1.0:
    assert gain == pytest.approx(strength, rel=0.05)


def test_a_machine_may_rub_far_more_than_declared_where_a_reference_shows_it():
  plant = JointModel(
    mujoco.MjModel.from_xml_string(PENDULUM), "joint", [log_of(PENDULUM, "sweep", duration=3.0)]
  )
  alone, beside = (constants(plant, healthy=healthy) for healthy in (False, True))
  at = alone.names.index("friction"), beside.names.index("friction")
  assert alone.high[at[0]] < 1.0 and beside.high[at[1]] == 4.0
  assert alone.low[at[0]] == beside.low[at[1]] > -1.0


def test_more_friction_than_a_reference_has_is_an_effect_and_less_is_a_changed_constant():
  logs = [log_of(PENDULUM, kind, duration=5.0) for kind in ("sweep", "slow")]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  usual = reference.reference_constants(JointLikelihood(plant, settings=SETTINGS), SETTINGS)
  known = known_terms(usual)[0]
  for freed in changed_constants(known):
    (at,) = np.flatnonzero(np.isinf(freed.prior))
    name, value = freed.names[at], known.centre[at]
    assert freed.low[at] < value - 0.1
    ends = [start[at] for start in freed.starts]
    assert all(freed.low[at] <= v <= max(freed.high[at], value) for v in ends)
    if name == "armature":  # no effect adds to it
      assert freed.high[at] > value + 0.5 and max(ends) > value + 0.5
    else:
      assert freed.high[at] == pytest.approx(value) and max(ends) == value


def test_constants_of_another_session_may_differ_by_more():
  logs = [log_of(PENDULUM, kind, duration=5.0) for kind in ("sweep", "slow")]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  usual = reference.reference_constants(JointLikelihood(plant, settings=SETTINGS), SETTINGS)
  same, other = (known_terms(usual, another_session=apart)[0] for apart in (False, True))
  more = {n for n, a, b in zip(same.names, same.prior, other.prior, strict=True) if a < b}
  assert more == {"damping", "friction", "gain", "limit", "latency"}
  assert same.centre == other.centre


def test_constants_differ_between_recordings_by_a_share_of_their_own_size():
  values = {"friction": 1.0, "gain": 0.0, "zero": 0.01, "latency": 0.004}
  friction, gain, zero, latency = differs(values, SETTINGS, False)
  repeat = dict(SETTINGS.repeat)
  assert friction == 2.0 * repeat["friction"] and gain == repeat["gain"]
  assert zero == repeat["zero"] and latency == repeat["latency"]
  assert differs(values, SETTINGS, True)[0] == 2.0 * dict(SETTINGS.another_session)["friction"]
