"""Effects that every episode draws from their intervals, in a task that is compiled once."""

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite.effects import Effect, drawing
from nerf2real.suite.op3 import constants
from tests.suite.synthetic import FlatRenderer, make_room

KNEE = constants.JOINT_NAMES.index("l_knee")
EFFECTS = (
  Effect("command_delay", None, {"delay": 0.04}, {"delay": (0.03, 0.05)}),
  Effect("motor_gain", "l_knee", {"gain": 0.6}, {"gain": (0.5, 0.7)}),
  Effect("payload", "l_el_link", {"mass": 0.2, "y": 0.07}, {"mass": (0.1, 0.3)}),
  Effect("floor_slope", None, {"x": 0.0, "y": 0.03}, {"y": (0.02, 0.04)}),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
  return make_room(tmp_path_factory.mktemp("room"))


def _load(room, **options):
  return suite.load(
    "nerf_nav", scene=room, renderer=FlatRenderer(), image_size=None, random=0, **options
  )


def _constants(environment):
  model = environment.physics.model.ptr
  arm = model.body("op3/l_el_link").id
  return np.array([model.actuator_gainprm[KNEE, 0], model.body_mass[arm], *model.opt.gravity[:2]])


def _play(environment, episodes):
  rows = []
  for _ in range(episodes):
    environment.reset()
    for _ in range(5):
      timestep = environment.step(environment.task.standing_action + 0.1)
    rows.append(timestep.observation["joint_positions"][-1].copy())
  return np.array(rows)


def test_values_are_drawn_from_their_intervals_and_others_stay():
  rng = np.random.default_rng(0)
  draws = [drawing.draw_effects(EFFECTS, rng) for _ in range(200)]
  gains = np.array([effects[1].parameters["gain"] for effects in draws])
  assert 0.5 <= gains.min() < 0.51 and 0.69 < gains.max() <= 0.7
  assert {effects[2].parameters["y"] for effects in draws} == {0.07}
  limited = Effect("command_delay", None, {"delay": 0.001}, {"delay": (-0.5, -0.1)})
  assert drawing.draw_effects([limited], rng)[0].parameters["delay"] == 0.0
  open_end = Effect("torque_limit", None, {"limit": 3.0}, {"limit": (2.0, np.inf)})
  assert drawing.draw_effects([open_end], rng)[0].parameters["limit"] == 3.0


def test_a_slope_leans_the_room():
  turned = drawing.as_gravity(EFFECTS[3])
  assert (turned.kind, turned.parameters["y"]) == ("gravity_tilt", -0.03)
  assert turned.intervals == {"y": (-0.04, -0.02)}
  assert drawing.as_gravity(EFFECTS[0]) is EFFECTS[0]


def test_a_sloping_floor_pulls_downhill(room):
  environment = _load(room, effects=[EFFECTS[3]])
  assert _constants(environment)[2] == pytest.approx(9.81 * np.sin(0.03), abs=1e-3)
  assert _constants(environment)[3] == pytest.approx(0.0, abs=1e-9)
  environment.reset()
  for _ in range(20):
    environment.step(environment.task.standing_action)
  assert not environment.task.fallen  # wherever in the room it stands


def test_every_episode_draws_and_the_model_is_restored(room):
  nominal = _constants(_load(room))
  environment = _load(room, effects=EFFECTS, draw_effects=True)
  found = []
  for _ in range(8):
    environment.reset()
    found.append(_constants(environment))
  found = np.array(found)
  gains = found[:, 0] / nominal[0]
  assert len(set(gains)) == 8 and (gains >= 0.5).all() and (gains <= 0.7).all()
  added = found[:, 1] - nominal[1]  # never the sum of episodes
  assert (added >= 0.1).all() and (added <= 0.3).all()
  slopes = found[:, 2] / 9.81
  assert (slopes > 0.0199).all() and (slopes < 0.0401).all()


def test_draws_follow_the_seed_and_leave_the_other_draws(room):
  first, second = (_load(room, effects=EFFECTS, draw_effects=True) for _ in range(2))
  np.testing.assert_array_equal(_play(first, 3), _play(second, 3))
  plain = _load(room)
  plain.reset()
  first = _load(room, effects=EFFECTS, draw_effects=True)
  first.reset()
  np.testing.assert_array_equal(first.task.draws.vector(), plain.task.draws.vector())


def test_values_without_intervals_are_those_of_the_effects(room):
  fixed = tuple(Effect(e.kind, e.target, e.parameters) for e in EFFECTS)
  drawn = _load(room, effects=fixed, draw_effects=True)
  np.testing.assert_array_equal(
    _play(drawn, 2), _play(_load(room, effects=fixed, draw_effects=False), 2)
  )


def test_a_late_command_is_late_from_the_start(room):
  environment = _load(room, effects=[Effect("command_delay", None, {"delay": 0.05})])
  for _ in range(2):
    environment.reset()
    control = environment.physics.data.ptr.ctrl
    before, moved = control[KNEE], []
    for _ in range(4):
      environment.step(environment.task.standing_action + 0.1)
      moved.append(control[KNEE] != before)
    assert moved == [False, False, True, True]


@pytest.mark.parametrize(
  ("kind", "values"),
  [
    ("stribeck_friction", {"breakaway": 0.3}),
    ("load_friction", {"coefficient": 0.2}),
    ("thermal_derating", {"heating": 3.0, "derating": 0.02}),
    ("supply_sag", {"droop": 0.05, "scales_limit": 1.0}),
    ("backlash", {"gap": 0.03}),
  ],
)
def test_a_seed_gives_the_same_episode_whatever_was_before(room, kind, values):
  environment = _load(room, effects=[Effect(kind, None, values)])

  def play(seed, steps):
    environment.random_state.seed(seed)
    timesteps = [environment.reset()]
    timesteps += [environment.step(environment.task.standing_action + 0.1) for _ in range(steps)]
    return timesteps

  first = play(1, 4)
  play(2, 10)
  for found, expected in zip(play(1, 4), first, strict=True):
    for name, value in expected.observation.items():
      np.testing.assert_array_equal(found.observation[name], value, err_msg=name)
