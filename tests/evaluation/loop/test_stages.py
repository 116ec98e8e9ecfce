"""The stages of a loop, each on its own: folder, trials, finding, environment, page, severity."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from nerf2real.agents.environments.loading import make_environment
from nerf2real.evaluation.episodes import Store
from nerf2real.evaluation.loop import comparing, naming, severity, story, telling, training, trials
from nerf2real.evaluation.loop.robot import machines
from nerf2real.evaluation.loop.sessions import Cooled
from nerf2real.evaluation.loop.settings import LoopSettings, claim, policy_folder
from nerf2real.evaluation.loop.trials import Condition
from nerf2real.real.safety.monitor import SafetyError
from nerf2real.real.virtual import undeclared
from nerf2real.suite.effects import Effect, write_effects
from tests.evaluation.fakes import episode

DELAY = undeclared.parse_all(["command_delay:0.045"])


def _settings(folder, **changes):
  given = {"out": folder, "policy": "walker", "trials": 2, "time_limit": 0.5, "preset": "tiny"}
  return LoopSettings(**{**given, **changes})


def test_a_folder_belongs_to_one_loop(tmp_path):
  claim(_settings(tmp_path, hidden=("command_delay:0.045",)))
  claim(_settings(tmp_path, hidden=("command_delay:0.045",), trials=9, minutes=3.0))
  path = tmp_path / "loop_settings.json"
  noted = json.loads(path.read_text())
  path.write_text(json.dumps({k: v for k, v in noted.items() if k != "reference"}))  # an older loop
  claim(_settings(tmp_path, hidden=("command_delay:0.045",)))
  path.write_text(json.dumps(noted | {"reference": "elsewhere"}))
  with pytest.raises(ValueError, match="another reference: take another"):
    claim(_settings(tmp_path, hidden=("command_delay:0.045",)))
  path.write_text(json.dumps(noted))
  with pytest.raises(ValueError, match="holds a loop with another hidden, seed: take another"):
    claim(_settings(tmp_path, hidden=("command_delay:0.05",), seed=2))
  assert (
    "0.045" not in (tmp_path / "loop_settings.json").read_text()
  )  # nothing tells before the end


@pytest.mark.parametrize(
  ("changes", "message"),
  [
    ({"trials": 0}, "--trials 0: expected at least 1"),
    ({"simulated": -1}, "--simulated -1: expected at least 1"),
    ({"processes": 0}, "--processes 0: expected at least 1"),
    ({"actors": 0}, "--actors 0: expected at least 1"),
    ({"preset": "best"}, "Unknown preset 'best'"),
    ({"teacher": "nobody"}, "Unknown teacher 'nobody'"),
  ],
)
def test_what_a_later_stage_would_refuse_is_refused_at_once(tmp_path, changes, message):
  with pytest.raises(ValueError, match=message):
    claim(_settings(tmp_path / "out", **changes))
  with pytest.raises(ValueError, match=r"lacks .*none/sweep.mcap, "):
    claim(_settings(tmp_path / "out", reference=tmp_path / "none"))
  assert not (tmp_path / "out").exists()


def test_a_policy_that_is_not_there_is_one_line(tmp_path):
  assert policy_folder(_settings(tmp_path)) is None
  assert (policy_folder(_settings(tmp_path, policy="shipped")) / "policy.json").exists()
  with pytest.raises(ValueError, match="Unknown policy") as found:
    policy_folder(_settings(tmp_path, policy=str(tmp_path / "nothing")))
  assert "\n" not in str(found.value)


def test_drawn_effects_follow_the_seed():
  assert machines.hidden_effects(["drawn"], 3) == undeclared.draw(3)
  both = machines.hidden_effects(["weak_knee", "drawn"], 3)
  assert {e.kind for e in both} >= {"motor_gain"} and len(both) > 1


def test_a_plants_label_tells_conditions_apart_and_not_what_is_hidden(tmp_path):
  settings = _settings(tmp_path, seed=4)
  path = tmp_path / "effects.json"
  write_effects(path, [Effect("command_delay", None, {"delay": 0.04})])
  conditions = [
    Condition(name="a", policy=None),
    Condition(name="b", policy=None, altered=DELAY),
    Condition(name="c", policy=None, altered=(DELAY[0].scaled(2.0),)),
    Condition(name="d", policy=None, simulated=True),
    Condition(name="e", policy=None, simulated=True, effects=path),
  ]
  labels = [trials.plant_label(settings, condition) for condition in conditions]
  assert len(set(labels)) == 5 and labels[0] == "robot 4" and labels[3] == "nominal"
  assert not any("delay" in label or "0.045" in label for label in labels)


def test_trials_are_run_once_and_more_are_added(tmp_path):
  condition = Condition(name="simulation, nominal", policy=None, simulated=True)
  from nerf2real.suite.scene import open_scene

  scene, said = open_scene(None), []
  store = Store(tmp_path)
  first = trials.run(_settings(tmp_path), condition, scene, store, said.append)
  assert [e.index for e in first] == [0, 53] and len(said) == 3
  said.clear()
  assert trials.run(_settings(tmp_path), condition, scene, Store(tmp_path), said.append) == first
  assert said == []
  more = trials.run(_settings(tmp_path, trials=3), condition, scene, store, said.append)
  assert [e.index for e in more] == [0, 26, 53] and "1 of 3 trials to run" in said[0]
  fewer = trials.run(_settings(tmp_path, trials=9, simulated=2), condition, scene, store, print)
  assert [e.index for e in fewer] == [0, 53]


def test_a_tally_has_the_exact_interval():
  found = trials.tally(
    "x", [episode(o, index=i) for i, o in enumerate(("success", "fall", "fall"))]
  )
  assert (found.trials, found.successes, found.outcomes["fall"]) == (3, 1, 2)
  assert (found.low, found.high) == pytest.approx((0.0084, 0.9057), abs=1e-4)
  assert str(found) == "33 % (1 of 3; 1 to 91 %)"


def _finding(folder, effects, verdict="effects"):
  folder.mkdir(parents=True)
  write_effects(folder / "effects.json", effects)
  error = {"held": {"before": 0.005, "after": 0.001}, "floor": 0.0005, "train": None}
  content = {"verdict": verdict, "error": error, "notes": ["a note"], "seconds": 12.0}
  (folder / "finding.json").write_text(json.dumps(content))
  return naming.name(folder, Path("no logs are read again"))


def test_a_finding_is_read_again_and_says_how_much_is_explained(tmp_path):
  effects = [
    Effect("parameter_error", "l_knee", {"gain": 1.1}),
    Effect("command_delay", None, {"delay": 0.045}, {"delay": (0.04, 0.05)}),
  ]
  named = _finding(tmp_path / "identified", effects)
  assert [effect.kind for effect in named.named] == ["command_delay"]
  assert named.share == pytest.approx(1 - (1.0 - 0.25) / (25.0 - 0.25))
  nothing = _finding(tmp_path / "other", [effects[0]], verdict="none")
  assert nothing.named == []


def test_what_the_reference_shows_too_is_not_named(tmp_path):
  folder = tmp_path / "identified"
  folder.mkdir()
  effects = [
    Effect("command_delay", None, {"delay": 0.045}),
    Effect("load_friction", "l_knee", {"coefficient": 0.2}),
    Effect("coulomb_friction", "r_knee", {"torque": 0.2}),
    Effect("motor_gain", "l_knee", {"gain": 0.5}),
  ]
  write_effects(folder / "effects.json", effects)
  servo = {"kind": "motor_gain", "joint": "l_knee", "parameters": {"gain": {"value": 0.9}}}
  content = {
    "verdict": "effects",
    "effects": [{"kind": "command_delay", "joint": None}],
    "in_reference": [{"kind": "load_friction", "joint": "l_knee"}, servo],
    "error": {"held": None, "floor": 0.0005, "train": None},
    "notes": [],
    "seconds": 1.0,
  }
  (folder / "finding.json").write_text(json.dumps(content))
  named = naming.name(folder, Path("no logs are read again"))
  assert [e.kind for e in named.named] == ["command_delay"]
  assert [e.kind for e in named.in_reference] == ["load_friction"]
  assert [e.kind for e in named.effects] == [e.kind for e in effects]


def test_training_draws_the_effects_of_the_finding(tmp_path):
  path = tmp_path / "effects.json"
  write_effects(path, [Effect("motor_gain", "l_knee", {"gain": 0.6}, {"gain": (0.5, 0.7)})])
  name = training.environment_name(_settings(tmp_path), None, path)
  assert name.startswith("suite:nerf_nav?image_size=12x16&time_limit=1&effects=")
  record = {key: {} for key in ("layout", "settings", "info", "sha256")} | {"format_version": 1}
  record["environment"] = "suite:nerf_nav?lens=l.yaml"
  (tmp_path / "policy.json").write_text(json.dumps(record))
  of_policy = training.environment_name(_settings(tmp_path), tmp_path, path)
  assert of_policy == f"suite:nerf_nav?lens=l.yaml&effects={path}&draw_effects=true"
  environment = make_environment(name + "&pushes=false", seed=0)
  gains = set()
  for _ in range(3):
    environment.reset()
    gains.add(float(environment._environment.physics.model.ptr.actuator_gainprm[12, 0]))
  task = environment._environment.task
  assert task.settings.draw_effects and task.settings.effects[0].intervals == {"gain": (0.5, 0.7)}


def test_an_unfinished_training_has_its_minutes(tmp_path):
  assert training._minutes(tmp_path) == 0.0
  counters = np.frombuffer(json.dumps({"elapsed": 90.0}).encode(), np.uint8)
  (tmp_path / "checkpoints").mkdir()
  np.savez(tmp_path / "checkpoints" / "newest-student.npz", counters=counters)
  assert training._minutes(tmp_path) == 1.5


def _story(tmp_path, after, *, trained=True):
  named = _finding(
    tmp_path / "identified",
    [Effect("command_delay", None, {"delay": 0.044}, {"delay": (0.04, 0.05)})],
  )
  path = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.2, 0.1]]

  def made(*outcomes):
    return [episode(o, index=i, path=path) for i, o in enumerate(outcomes)]

  episodes = {
    story.HEALTHY: made("success", "success", "success", "fall"),
    story.BEFORE: made("fall", "fall", "collision", "fall"),
    story.NOMINAL: made("success", "success", "success", "success"),
    story.WITH_EFFECTS: made("fall", "fall", "success", "fall"),
    story.AFTER: made(*after),
  }
  made_on = training.Trained(tmp_path, "quick", {"quick": 5, "steady": 4}, 6, 20.0, 9000, 700)
  return story.Story(
    LoopSettings(out=tmp_path, policy="walker"),
    episodes,
    named,
    made_on if trained else None,
    comparing.compare(DELAY, named.effects),
    {story.BEFORE: [Cooled(3, "l_knee: 71 degrees C")], story.AFTER: []},
    {"training": 100.0},
  )


def test_five_numbers_and_what_came_back(tmp_path):
  told = _story(tmp_path, ("success", "success", "fall", "fall"))
  assert story.recovered(told) == pytest.approx(2 / 3)
  figures = telling.five_numbers(told)
  assert len(figures) == 5
  assert figures[1].value.startswith("0 % (0 of 4") and figures[-1].value == "67 % of 3 trials"
  text = telling.as_text(told)
  assert "hidden: command_delay:0.045; named: command_delay: delay 0.044 s (0.04 to 0.05)" in text
  summary = story.summary(told)
  assert json.loads(json.dumps(summary)) == summary
  # Of robot (3 falls, 1 collision) and simulation (3 falls, 1 success) one trial in four differs.
  assert story.gaps(told)[story.WITH_EFFECTS] == pytest.approx((0.25, 0.25))
  assert story.gaps(told)[story.NOMINAL] == pytest.approx((1.0, 1.0))
  assert summary["success"][story.AFTER]["successes"] == 2 and summary["hidden"]["wrong"] == []
  assert summary["cooled"] == {story.BEFORE: [{"trials": 3, "detail": "l_knee: 71 degrees C"}]}


def test_where_no_success_was_lost_none_can_come_back(tmp_path):
  told = _story(tmp_path, ("success",) * 4)
  same = told._replace(episodes=told.episodes | {story.BEFORE: told.episodes[story.HEALTHY]})
  assert story.recovered(same) is None
  assert telling.five_numbers(same)[-1].value == "nothing was lost"


def test_the_page_tells_the_story_in_order_and_what_was_hidden_last(tmp_path):
  told = _story(tmp_path, ("success", "success", "success", "fall"))
  telling.write(tmp_path / "loop.html", told)
  page = (tmp_path / "loop.html").read_text()
  titles = ["Five numbers", "Before", "What the recordings say", "In the simulation"]
  titles += ["Trained on", "After", "How the trials ended", "What was hidden"]
  places = [page.index(f"<h2>{title}</h2>") for title in titles]
  assert places == sorted(places)
  assert page.count("<img ") == 6
  assert page.index("command_delay:0.045") > places[-1]
  assert "robot before, after 3 trials: l_knee: 71 degrees C." in page


def test_the_page_names_an_adapted_teacher_and_no_file(tmp_path):
  told = _story(tmp_path, ("success",) * 4)
  told = told._replace(trained=told.trained._replace(teacher=str(tmp_path / "teacher.json")))
  telling.write(tmp_path / "loop.html", told)
  page = (tmp_path / "loop.html").read_text()
  assert ">adapted<" in page and "teacher.json" not in page


@pytest.mark.parametrize(
  ("verdict", "effects", "why"),
  [
    ("none", [], "Nothing was named: the policy stays as it was"),
    (
      "effects",
      [Effect("command_delay", None, {"delay": 0.04})],
      "No success was lost in these trials: the policy stays as it was",
    ),
  ],
)
def test_why_a_policy_was_not_trained_is_said(tmp_path, verdict, effects, why):
  told = _story(tmp_path, ("success",) * 4, trained=False)
  told = told._replace(named=_finding(tmp_path / "other", effects, verdict))
  telling.write(tmp_path / "loop.html", told)
  assert why in (tmp_path / "loop.html").read_text()


def test_what_a_real_robot_lost_is_judged_by_the_nominal_simulation(tmp_path):
  tallies = _story(tmp_path, ("success",) * 4).tallies
  assert story.lost(tallies) == pytest.approx(0.75)
  del tallies[story.HEALTHY]
  assert story.lost(tallies) == pytest.approx(1.0)


def test_severity_stops_where_success_has_fallen(tmp_path, monkeypatch):
  shares = {0.0: 10, 1.0: 9, 1.5: 8, 2.0: 6, 3.0: 0}
  asked = []

  def run(settings, condition, scene, store, say):
    factor = float(condition.name.split()[1])
    asked.append((factor, condition.altered))
    return [episode("success" if i < shares[factor] else "fall", index=i) for i in range(10)]

  monkeypatch.setattr(trials, "run", run)
  settings = _settings(tmp_path, hidden=("command_delay:0.02",), trials=10)
  steps = severity.find_severity(settings, lambda text: None)
  assert [step.factor for step in steps] == [0.0, 1.0, 1.5, 2.0]
  assert asked[0][1] == () and asked[-1][1][0].values == (0.04,)
  text = severity.as_text(steps)
  assert "| 2 | command_delay:0.04 | 60 % (6 of 10; 26 to 88 %) | 6 success, 4 fall |" in text
  assert "Success falls by 30 points: by 40 at the last size." in text
  with pytest.raises(ValueError, match="0 hidden effects, expected"):
    severity.find_severity(dataclasses.replace(settings, hidden=()), print)


def test_severity_ends_where_the_robot_itself_gives_up(tmp_path, monkeypatch):
  def run(settings, condition, scene, store, say):
    if condition.altered:
      label = trials.plant_label(settings, condition)
      begun = episode("success", index=0)
      kept = dataclasses.replace(begun.setting, plant_id=label)
      store.add(dataclasses.replace(begun, setting=kept))
      raise SafetyError("Torque was switched off: low voltage (9.9 V).")
    return [episode("success", index=i) for i in range(2)]

  monkeypatch.setattr(trials, "run", run)
  settings = _settings(tmp_path, hidden=("supply_course:2.3",))
  steps = severity.find_severity(settings, lambda text: None)
  assert [(step.factor, step.tally.trials) for step in steps] == [(0.0, 2), (1.0, 1)]
  text = severity.as_text(steps)
  assert "100 % (1 of 1; 2 to 100 %), then none begins" in text
  assert "gives up at the last size: Torque was switched off: low voltage (9.9 V)." in text
  monkeypatch.setattr(trials, "run", lambda *_: (_ for _ in ()).throw(SafetyError("no robot")))
  with pytest.raises(SafetyError, match="no robot"):  # with nothing hidden: it is none of this
    severity.find_severity(settings, lambda text: None)
