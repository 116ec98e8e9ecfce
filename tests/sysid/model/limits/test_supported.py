"""What of a declared model is simulated, and what is refused."""

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.data import opening
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.limits.supported import left_out, on_a_stand, without_disabled
from nerf2real.sysid.outputs import notes
from tests.sysid.synthetic import ARM, PENDULUM, log_of

SERVO = '<position name="joint" joint="joint"'
END = "</mujoco>"


SITE = '<site name="on" pos="0 0 -0.2"/>'
SPATIAL = '<tendon><spatial springlength="0.1" stiffness="40"><site site="a"/><site site="on"/>'
ANCHOR = '<worldbody><site name="a" pos="0.1 0 0.2"/><body'
WALL = '<worldbody><geom type="box" size="0.1 0.1 0.1" pos="0.15 0 -0.2"/><body'
BALL = '<geom size="0.04" pos="0 0 -0.2" mass="0"/><inertial'


@pytest.mark.parametrize(
  ("changes", "found"),
  [
    ([(SERVO, f'{SERVO} timeconst="0.02"')], "time constant"),
    ([(SERVO, f'{SERVO} delay="0.03" nsample="40"')], "a delay"),
    ([(SERVO, f'{SERVO} armature="0.02"')], "armature or damping of its own"),
    (
      [
        ('<body name="arm">\n    <joint', '<body name="arm" gravcomp="1">\n    <joint'),
        ("<joint name", '<joint actuatorgravcomp="true" actuatorfrcrange="-3 3" name'),
      ],
      "gravity compensation within",
    ),
    ([(END, f'<equality><joint joint1="joint"/></equality>{END}')], "an equality"),
    (
      [
        (END, '<tendon><fixed stiffness="1"><joint joint="joint" coef="1"/></fixed></tendon>' + END)
      ],
      "a tendon",
    ),
    (
      [
        ("<worldbody><body", ANCHOR),
        ("</body>", f"{SITE}</body>"),
        (END, f"{SPATIAL}</spatial></tendon>{END}"),
      ],
      "springs beyond",
    ),
    ([("<option", '<option density="1e5"')], "a fluid"),
    ([('damping="1.0"', 'damping="1.0 0 0.05"')], "damping beyond"),
    ([("<joint name", '<joint stiffness="2 0 6" name')], "springs beyond"),
    ([("<worldbody><body", WALL), ("<inertial", BALL)], "contacts"),
    ([("<joint name", '<joint range="-20 20" name')], "the end of its range"),
  ],
)
def test_what_the_simulation_of_a_joint_leaves_out_is_refused(changes, found):
  log = log_of(PENDULUM, "sweep", duration=4.0)
  assert left_out(mujoco.MjModel.from_xml_string(PENDULUM), [log]) == {}
  changed = PENDULUM
  for old, new in changes:
    assert old in changed
    changed = changed.replace(old, new, 1)
  with pytest.raises(ValueError, match=f"{found}.* at joint 'joint'"):
    left_out(mujoco.MjModel.from_xml_string(changed), [log])


def test_what_a_models_flags_switch_off_is_not_there():
  off = PENDULUM.replace(
    "<worldbody>",
    '<option><flag gravity="disable" frictionloss="disable"/></option><worldbody>',
  )
  model = without_disabled(mujoco.MjModel.from_xml_string(off))
  log = log_of(off, "sweep", duration=4.0, rounding=0.0)
  plant = JointModel(model, "joint", [log])
  own = compose(plant, (), np.zeros(0))
  course = plant.run(own.p, own.loads, 0, table=own.table).position
  assert np.sqrt(np.mean((course - log.states.position[:, 0]) ** 2)) < 1e-6
  assert left_out(model, [log]) == {}


@pytest.mark.parametrize(
  ("old", "new"),
  [
    ('<joint name="joint"', '<joint name="joint" actuatorfrcrange="-2 1"'),
    (SERVO, f'{SERVO} ctrlrange="-0.3 0.5"'),
  ],
)
def test_ranges_of_force_and_command_hold_at_one_joint_as_in_mujoco(old, new):
  limited = PENDULUM.replace(old, new)
  model = mujoco.MjModel.from_xml_string(limited)
  log = log_of(limited, "steps", duration=4.0, rounding=0.0)
  plant = JointModel(model, "joint", [log])
  own = compose(plant, (), np.zeros(0))
  course = plant.run(own.p, own.loads, 0, table=own.table).position
  free = log_of(PENDULUM, "steps", duration=4.0).states.position[:, 0]
  assert np.abs(course - free).max() > 0.05, "the limit must act"
  assert np.sqrt(np.mean((course - log.states.position[:, 0]) ** 2)) < 1e-6


def test_a_joint_that_cannot_be_simulated_alone_stands_in_no_others_way():
  slow = ARM.replace('"elbow" joint="elbow"', '"elbow" joint="elbow" timeconst="0.05"')
  model = mujoco.MjModel.from_xml_string(slow)
  told = log_of(slow, "sweep", duration=4.0)
  beyond = left_out(model, [told])
  assert list(beyond) == ["elbow"] and "time constant" in beyond["elbow"]
  log = opening.set_aside(told, beyond)
  assert log.commands.joints == ("shoulder",) and log.joints == told.joints
  np.testing.assert_array_equal(log.commands.position, told.commands.position[:, :1])
  assert simulation.error(model, [log]) < 1e-3, "it must move as it was told"
  (note,) = notes.not_judged(beyond)
  assert "elbow (an actuator with a time constant" in note and notes.not_judged({}) == []
  tied = ARM.replace(END, f'<equality><joint joint1="elbow" joint2="shoulder"/></equality>{END}')
  with pytest.raises(ValueError, match="an equality constraint at joint 'shoulder'"):
    left_out(mujoco.MjModel.from_xml_string(tied), [told])


def test_a_free_base_is_held_where_the_model_has_it(tmp_path):
  base = '<worldbody><body name="base" pos="0 0 1"><inertial pos="0 0 0" mass="1" '
  base += 'diaginertia="1e-2 1e-2 1e-2"/><freejoint/>'
  free = ARM.replace("<worldbody>", base).replace("</worldbody>", "</body></worldbody>")
  path = tmp_path / "free.xml"
  path.write_text(free)
  model = mujoco.MjModel.from_xml_path(str(path))
  log = log_of(ARM, "sweep", duration=4.0)
  assert simulation.error(model, [log]) > 0.01
  assert simulation.error(on_a_stand(path, model), [log]) < 1e-3
  fixed = mujoco.MjModel.from_xml_string(ARM)
  assert on_a_stand(path, fixed) is fixed
  note = " ".join(notes.on_stand(free=True))
  assert "held" in note and not notes.on_stand(free=False)
  path.write_text(free.replace("<option", '<option gravity="0 0 0"'))
  with pytest.raises(ValueError, match="nothing holds it"):
    on_a_stand(path, mujoco.MjModel.from_xml_path(str(path)))
