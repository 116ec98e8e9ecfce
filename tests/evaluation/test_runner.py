"""How episodes are classified, which are run, and what a learned policy's belief leaves behind."""

import jax
import numpy as np
import pytest

from nerf2real.agents.dmpo import belief, config, networks, presets, training_state
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.core.serialization import to_plain
from nerf2real.evaluation import episodes, runner, session
from nerf2real.evaluation.plants import operated
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.plant import Sight
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.policy import Belief
from nerf2real.evaluation.report import page as report
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.pose import Pose
from tests.evaluation.fakes import FAR, TRIAL, ScriptedPlant, StillPolicy

NEAR = FAR._replace(pose=Pose(0.8, 0.0, 0.0))  # 0.2 m from the goal


def _run(script, **changes):
  return runner.run_trial(
    ScriptedPlant(script, **changes), StillPolicy(), TRIAL, group="navigation", index=7
  )


@pytest.mark.parametrize(
  ("script", "reason", "outcome", "steps"),
  [
    ([FAR] * 5 + [NEAR] * 5, "", "success", 5),
    ([FAR] * 5 + [FAR._replace(collided=True)] * 5, "", "collision", 5),
    ([FAR] * 5 + [FAR._replace(fallen=True)] * 5, "", "fall", 5),
    ([FAR] * 3 + [FAR._replace(fallen=True, collided=True)] * 5, "", "collision", 3),
    ([FAR] * 3 + [NEAR._replace(fallen=True)], "", "fall", 3),  # at the goal, but fallen
    ([FAR] * 9, "", "lost", 8),
    ([FAR] * 4, "low voltage: 10.1 V", "stopped", 3),
  ],
)
def test_outcomes(script, reason, outcome, steps):
  found = _run(script, reason=reason)
  assert found.outcome == outcome and found.duration == pytest.approx(0.025 * steps)
  assert (found.time is not None) == (outcome == "success") and found.index == 7
  assert reason in found.detail


def test_ball_reaches_its_square():
  def ball(x):
    return Sight(Pose(0, 0, 0), np.array([x, 0.3]), False, False)

  for x, outcome in ((0.49, "lost"), (0.51, "success")):
    found = _run([ball(0.0)] * 3 + [ball(x)] * 3, protocol="ball", goal=(1.0, 0.0))
    assert found.outcome == outcome and len(found.ball_path) >= 1


def test_localisation_error_is_the_mean_over_the_episode():
  halves = Belief(np.log([0.5, 0.5]), np.array([[0.0, 0.3, 0], [0.0, 0.5, 0]]), np.ones((2, 3)))
  found = runner.run_trial(
    ScriptedPlant([FAR] * 90), StillPolicy(halves), TRIAL, group="navigation", index=0
  )
  assert found.localisation_error == pytest.approx(0.4)
  assert [m.time for m in found.moments] == [0.0, 0.5, 1.0, 1.5, 2.0]
  assert found.path[1] == [0.2, 0.0, 0.0, 0.0]


def test_only_missing_trials_are_run(tmp_path):
  store, plant = episodes.Store(tmp_path), ScriptedPlant([FAR] * 4)
  chosen = list(enumerate(plants.trials("navigation")))[:5]
  assert runner.run_all(plant, StillPolicy(), chosen[:3], store=store) == 3
  again = episodes.Store(tmp_path)
  assert runner.run_all(plant, StillPolicy(), chosen, store=again) == 2 and plant.started == 5
  other = ScriptedPlant([FAR] * 4)
  other.plant_id = "another"
  assert runner.run_all(other, StillPolicy(), chosen, store=again) == 5
  other.conditions = "scene office (1a2b3c4d)"
  assert runner.run_all(other, StillPolicy(), chosen, store=again) == 5


def test_operator_may_repeat_an_episode(tmp_path):
  answers = ["repeat", ("success", 1.5, "")]

  class Judged(ScriptedPlant):
    def judge(self):
      answer = answers.pop(0)
      if answer == "repeat":
        raise operated.RepeatError
      return answer

  store, plant = episodes.Store(tmp_path), Judged([FAR] * 4)
  runner.run_all(plant, StillPolicy(), [(0, ("navigation", TRIAL))], store=store)
  assert plant.started == 2 and store.episodes[0].time == 1.5 and store.episodes[0].success


def test_protocols_have_the_papers_numbers():
  assert len(plants.trials("navigation")) == 54
  groups = [group for group, _ in plants.trials("ball")]
  assert groups.count("center") == 32 and groups.count("wall") == 14
  gains = [group for group, _ in plants.trials("gain")]
  assert {gain: gains.count(gain) for gain in gains} == dict.fromkeys(
    ("gain 128", "gain 90", "gain 50", "gain 10", "gain 1"), 5
  )
  with pytest.raises(ValueError, match="Unknown protocol 'walk'"):
    plants.trials("walk")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
  """An untrained policy with pictures and a belief, for the suite's observations."""
  preset = config.override(presets.preset("vision_small"), {"network.lstm_size": 8, "history": 1})
  names = ("accelerometer", "goal", "gravity", "gyroscope", "joint_positions", "previous_control")
  layout = Layout(
    image_name="camera",
    image_shape=(30, 40, 3),
    state_names=names,
    state_sizes=(15, 2, 15, 15, 100, 100),
    action_size=20,
    privileged_names=("privileged/robot_position", "privileged/robot_rotation"),
    privileged_sizes=(3, 9),
  )

  def init(key):
    size = networks.embedding_size(preset.network, layout)
    return {
      "policy": networks.init_policy(key, preset.network, layout),
      "belief": belief.init_belief(key, preset.network, size),
    }

  before = jax.config.read("jax_disable_most_optimizations")
  jax.config.update("jax_disable_most_optimizations", True)  # compiled once, run once
  parameters = jax.jit(init)(jax.random.key(0))
  jax.config.update("jax_disable_most_optimizations", before)
  folder = tmp_path_factory.mktemp("run") / "policy"
  export.export_policy(
    folder,
    training_state.flatten_params(parameters),
    layout=layout,
    environment="suite:nerf_nav",
    settings=to_plain(preset),
    info={},
  )
  return folder


def test_learned_policy_needs_nothing_privileged_and_its_belief_is_drawn(exported, tmp_path):
  policy = LearnedPolicy(exported, seed=0, stochastic=False)
  assert policy.image_size == (30, 40) and len(policy.policy_id) == 12
  plant = ScriptedPlant([FAR] * 50, image=(30, 40, 3))
  found = runner.run_trial(plant, policy, TRIAL, group="navigation", index=0)
  assert found.setting.resolution == "30 x 40" and found.outcome == "lost"
  assert found.localisation_error > 0 and len(found.moments) == 3 and found.moments[0].picture
  again = runner.run_trial(plant, policy, TRIAL, group="navigation", index=0)
  assert again == found  # nothing of the last episode is left in the policy
  report.write(tmp_path / "r.html", [found], scene=EmptyFloor())
  page = (tmp_path / "r.html").read_text()
  assert "Where the policy believed to be" in page and "episode 1 (lost), 1.0 s" in page
  assert page.count("data:image/jpeg") == 1 + 3


def test_drawn_actions_differ_by_trial_and_repeat(exported):
  policy = LearnedPolicy(exported, seed=0, stochastic=True)
  actions = []

  class Noting(ScriptedPlant):
    def step(self, action):
      actions.append(action)
      return super().step(action)

  firsts = []
  for index in (0, 1, 0):  # the second is a repetition of the first's start
    actions.clear()
    trial = plants.trials("navigation")[index][1]
    plant = Noting([FAR] * 3, image=(30, 40, 3))
    runner.run_trial(plant, policy, trial, group="navigation", index=index)
    firsts.append(actions[0])
  np.testing.assert_array_equal(firsts[0], firsts[2])
  assert (firsts[0] != firsts[1]).any()


def test_trials_may_be_spread():
  listed = plants.trials("navigation")
  chosen = session.choose(listed, 4)
  assert [index for index, _ in chosen] == [0, 18, 35, 53]
  assert len(session.choose(listed, None)) == 54 and len(session.choose(listed, 99)) == 54
  again = session.choose(listed, None, repetition=1)
  assert [index for index, _ in again] == list(range(1, 54, 2))
  assert [index for index, _ in session.choose(listed, 3, repetition=1)] == [1, 27, 53]
  with pytest.raises(ValueError, match="--repetition 2: expected one of 0, 1"):
    session.choose(listed, None, repetition=2)
  ball = plants.trials("ball")
  assert [index for index, _ in session.choose(ball, None, group="wall")] == list(range(32, 46))
  assert [index for index, _ in session.choose(ball, 2, group="center")] == [0, 31]
  found = session.choose(ball, None, indices=(44, 3), group="wall")
  assert [index for index, _ in found] == [44]
  with pytest.raises(ValueError, match="--indices 46: expected 0 to 45"):
    session.choose(ball, None, indices=(46,))
  with pytest.raises(ValueError, match="--group walls: expected one of center, wall"):
    session.choose(ball, None, group="walls")
  with pytest.raises(ValueError, match="no trial of .*--group wall and --indices 3 together"):
    session.choose(ball, None, indices=(3,), group="wall")
