"""Control experiments: what a policy is shown, how its episodes are kept, and several plants."""

import json

import numpy as np
import pytest

from nerf2real.core.serialization import to_plain
from nerf2real.evaluation import episodes, runner, session
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.policies import controls
from nerf2real.evaluation.report import tables
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite.gaits.floor import EmptyFloor
from tests.evaluation.fakes import FAR, TRIAL, ScriptedPlant, StillPolicy, episode

GOALS = np.array([[1.0, 0.0], [0.0, 2.0], [-1.0, -1.0]])


class Room(EmptyFloor):
  """A floor with three goals."""

  def __init__(self):
    super().__init__()
    self.goals = GOALS


class Watching(StillPolicy):
  """Keeps what it is shown."""

  image_size = (4, 6)

  def __init__(self):
    super().__init__()
    self.seen, self.goals = [], []

  def act(self, observation, *, goal, sight):
    self.seen.append(observation)
    self.goals.append(goal)
    return super().act(observation, goal=goal, sight=sight)


def _run(control, *, script=None):
  policy = Watching()
  controlled = controls.under_control(policy, control, scene=Room(), protocol="navigation")
  plant = ScriptedPlant(script or [FAR] * 4, goal=GOALS[0], image=(4, 6, 3))
  found = runner.run_trial(plant, controlled, TRIAL, group="navigation", index=0)
  return policy, found


def test_black_pictures_and_nothing_else():
  plain, _ = _run("none")
  black, found = _run("black")
  assert found.setting.control == "black" and found.setting.policy_id == "0123"
  for before, after in zip(plain.seen, black.seen, strict=True):
    assert before["camera"].any() and not after["camera"].any()
    assert after["camera"].shape == before["camera"].shape and after["camera"].dtype == np.uint8
    for name in set(before) - {"camera"}:
      np.testing.assert_array_equal(before[name], after[name])
  np.testing.assert_array_equal(black.goals, plain.goals)


def test_another_goal_and_success_at_the_trials_own():
  near = FAR._replace(pose=FAR.pose._replace(x=0.9))
  policy, found = _run("other_goal", script=[FAR] * 3 + [near] * 3)
  assert found.outcome == "success" and found.goal == (1.0, 0.0)
  for observation, goal in zip(policy.seen, policy.goals, strict=True):
    np.testing.assert_allclose(observation["goal"], GOALS[1])
    np.testing.assert_allclose(goal, GOALS[1])
    assert observation["camera"].any()
  for index in range(3):
    assert (controls.other_goal(GOALS, GOALS[index]) == GOALS[(index + 1) % 3]).all()


def test_what_cannot_be_falsified_is_refused():
  for control, policy, scene, protocol, message in (
    ("black", StillPolicy(), Room(), "navigation", "still looks at no pictures"),
    ("other_goal", Watching(), Room(), "ball", "no other goal in the protocol 'ball'"),
    ("other_goal", Watching(), EmptyFloor(), "navigation", "no other goal"),
    ("red", Watching(), Room(), "navigation", "Unknown control 'red'"),
  ):
    with pytest.raises(ValueError, match=message):
      controls.under_control(policy, control, scene=scene, protocol=protocol)


def test_controls_are_run_beside_the_plain_trials_and_counted_apart(tmp_path):
  store = episodes.Store(tmp_path)
  chosen = list(enumerate(plants.trials("navigation")))[:3]
  for control in ("none", "black", "none"):
    policy = controls.under_control(Watching(), control, scene=Room(), protocol="navigation")
    runner.run_all(ScriptedPlant([FAR] * 3), policy, chosen, store=store)
  again = episodes.Store(tmp_path)
  assert [e.setting.control for e in again.episodes] == ["none"] * 3 + ["black"] * 3
  (table,) = tables.paper_tables(again.episodes)
  assert table.rows[0].cells[0].endswith("(n=3)")
  rows = tables.outcome_table(again.episodes).rows
  assert [row.name.endswith(", control black") for row in rows] == [False, True]


def test_episodes_of_an_older_release_have_no_control(tmp_path):
  plain = to_plain(episode())
  del plain["setting"]["control"]
  (tmp_path / "episodes.jsonl").write_text(json.dumps(plain) + "\n")
  assert episodes.Store(tmp_path).episodes == [episode()]


def test_rates_have_exact_intervals():
  assert tables.exact_rate(54, 54) == "54/54, 93 to 100 %"
  assert tables.exact_rate(4, 9) == "4/9, 14 to 79 %"  # R: binom.test(4, 9)
  found = [episode(index=0), episode("lost", index=1), episode("fall", index=2)]
  row = tables.outcome_table(found).rows[0]
  assert "1/3, 1 to 91 %" in row.cells


def test_a_command_runs_on_the_simulation_and_on_several_robots():
  wanted = EvaluationSettings(plant="both", robot_seed=(1, 3, 3))
  found = session.each_plant(wanted)
  assert [(s.plant, s.robot_seed) for s in found] == [
    ("sim", (1, 3, 3)),
    ("virtual", (1,)),
    ("virtual", (3,)),
  ]
  assert session.each_plant(EvaluationSettings(plant="virtual"))[0].robot_seed == (1,)
  assert [s.plant for s in session.each_plant(EvaluationSettings(plant="robot"))] == ["robot"]
  with pytest.raises(ValueError, match="names no virtual robot"):
    session.each_plant(EvaluationSettings(plant="both", robot_seed=()))
