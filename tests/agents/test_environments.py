"""Options of the suite's environments, their evaluations, trials, exact intervals."""

import numpy as np
import pytest

from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.environments import loading
from nerf2real.agents.environments.loading import evaluation_name, make_environment
from nerf2real.suite import protocols

LENS = """
image_width: 400
image_height: 300
camera_matrix: {data: [350, 0, 199.5, 0, 352, 149.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {data: [0.1, -0.2, 0, 0, 0]}
"""


def test_randomisation_lens_and_camera_reach_the_suite(tmp_path):
  lens = tmp_path / "camera_info.yaml"
  lens.write_text(LENS)
  name = (
    f"suite:nerf_nav?pushes=false&push_force=2,6&max_torso_mass=0.1&camera_rate=15&camera_gain=0.5"
    f"&lens={lens}&image_size=30x40&time_limit=2"
  )
  task = task_of(make_environment(name, seed=0))
  drawn, camera = task.settings.randomisation, task.robot_camera
  assert (drawn.pushes, drawn.push_force, drawn.max_torso_mass) == (False, (2.0, 6.0), 0.1)
  assert drawn.delays  # what is not named stays
  assert (camera.settings.rate, camera.settings.gain) == (15.0, 0.5)
  assert (camera.camera.width, camera.camera.fx, camera.camera.k1) == (40, 35.0, 0.1)
  assert task.settings.time_limit == 2.0


@pytest.mark.parametrize(
  ("options", "message"),
  [
    ("pushes=no", "pushes must be true or false"),
    ("push_force=3", "push_force must be numbers such as"),
    ("camera_rate=fast", "camera_rate must be a number"),
    ("camera_rate=50", "at most that of the control, 40 Hz"),
    ("protocol=ball", "no protocol 'ball': expected one of navigation, gain"),
    ("lens=/nowhere.yaml", "nowhere.yaml"),
    ("draw_effects=1", "draw_effects must be true or false"),
    ("colour=red", "Unknown options"),
  ],
)
def test_wrong_options_are_one_clear_error(options, message):
  with pytest.raises((ValueError, OSError), match=message):
    make_environment(f"suite:nerf_nav?{options}", seed=0)


def test_evaluation_is_the_table_s_protocol_without_pushes():
  assert evaluation_name("suite:nerf_nav") == "suite:nerf_nav?protocol=navigation&pushes=false"
  assert evaluation_name("suite:ball_push?scene=out/room&pushes=true&camera_rate=15") == (
    "suite:ball_push?protocol=ball&scene=out/room&pushes=false&camera_rate=15"
  )
  assert evaluation_name("suite:nerf_nav?protocol=gain").startswith("suite:nerf_nav?protocol=gain")
  assert evaluation_name("agents:cue") == "agents:cue"


def test_options_of_a_name_are_changed_added_or_left():
  changed = loading.with_options("suite:x?a=1,2&s=out/b", {"a": "3"}, defaults={"s": "y", "d": "4"})
  assert changed == "suite:x?s=out/b&d=4&a=3"
  assert loading.with_options("suite:x", {"a": "1"}) == "suite:x?a=1"


def test_trials_of_the_protocol_are_set_up_and_seeded():
  name = "suite:nerf_nav?protocol=navigation&time_limit=0.05"
  first, second = (make_environment(name, seed=5) for _ in range(2))
  wrapped, other = loading.trials_of(first), loading.trials_of(second)
  assert wrapped.count == 54
  listed = protocols.navigation()
  assert wrapped.spread(27) == [t for t in listed if t.trial == 0]
  assert wrapped.spread(27, without=wrapped.spread(27)) == [t for t in listed if t.trial == 1]
  most = wrapped.spread(36)
  assert len(most) == 36
  assert wrapped.spread(36, without=most) == [t for t in listed if t not in most]
  assert wrapped.spread(54, without=listed) == list(listed)
  assert wrapped.spread(99) == list(listed)
  other.choose(listed[7:8], seed=5)
  second.reset()
  for trial in listed[:8]:
    first.reset()
    task = task_of(first)
    np.testing.assert_allclose(task.start.xy, task.evaluation_starts[trial.position])
    assert (task.start.yaw, task.goal_index) == (trial.yaw, trial.goal)
  # What a trial draws does not depend on those before it; with another seed it does change.
  assert task_of(first).draws.torso_mass == task_of(second).draws.torso_mass
  other.choose(listed[7:8], seed=6)
  second.reset()
  assert task_of(first).draws.torso_mass != task_of(second).draws.torso_mass
