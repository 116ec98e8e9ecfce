"""What of a declared model is simulated, and what is refused."""

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.data import opening
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.supported import check_supported, on_a_stand
from nerf2real.sysid.outputs import notes
from tests.sysid.synthetic import ARM, PENDULUM, log_of

SERVO = '<position name="joint" joint="joint"'
END = "</mujoco>"


@pytest.mark.parametrize(
  ("old", "new", "found"),
  [
    (SERVO, f'{SERVO} timeconst="0.02"', "time constant"),
    (
      '<body name="arm">\n    <joint',
      '<body name="arm" gravcomp="1"><joint actuatorgravcomp="true" actuatorfrcrange="-3 3"',
      "gravity compensation within",
    ),
    (END, f'<equality><joint joint1="joint"/></equality>{END}', "an equality"),
    (
      END,
      '<tendon><fixed stiffness="1"><joint joint="joint" coef="1"/></fixed></tendon>' + END,
      "a tendon",
    ),
  ],
)
def test_what_the_simulation_of_a_joint_leaves_out_is_refused(old, new, found):
  check_supported(mujoco.MjModel.from_xml_string(PENDULUM), ["joint"])
  changed = PENDULUM.replace(old, new, 1)
  assert changed != PENDULUM
  with pytest.raises(ValueError, match=f"{found}.* at joint 'joint'"):
    check_supported(mujoco.MjModel.from_xml_string(changed), ["joint"])


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


def test_a_joint_that_cannot_be_simulated_alone_stands_in_no_others_way(tmp_path, monkeypatch):
  tied = ARM.replace(END, f'<equality><joint joint1="elbow"/></equality>{END}')
  model = mujoco.MjModel.from_xml_string(tied)
  told = log_of(ARM, "sweep", duration=2.0)
  monkeypatch.setattr(opening, "read_log", lambda _: told)
  (log,) = opening.read_logs([tmp_path], model)
  assert log.commands.joints == ("shoulder",) and log.joints == told.joints
  np.testing.assert_array_equal(log.commands.position, told.commands.position[:, :1])
  check_supported(model, log.commands.joints)
  (note,) = notes.beyond(model, log)
  assert "elbow (an equality constraint)" in note
  both = mujoco.MjModel.from_xml_string(
    tied.replace('"elbow"/></eq', '"elbow" joint2="shoulder"/></eq')
  )
  (log,) = opening.read_logs([tmp_path], both)
  with pytest.raises(ValueError, match="an equality constraint at joint 'shoulder'"):
    check_supported(both, log.commands.joints)
  assert notes.beyond(mujoco.MjModel.from_xml_string(ARM), told) == []


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
