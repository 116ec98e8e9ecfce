"""Sessions of a loop's robots: the battery goes on, a hot joint ends them, a cool robot goes on."""

from types import SimpleNamespace

import pytest

from nerf2real.evaluation.episodes import Store
from nerf2real.evaluation.loop import sessions, trials
from nerf2real.evaluation.loop.sessions import Cooled, Session
from nerf2real.evaluation.loop.settings import LoopSettings
from nerf2real.evaluation.loop.trials import Condition
from nerf2real.real.safety.monitor import Reason, SafetyError, Stop
from tests.evaluation.fakes import FAR, ScriptedPlant

HOT = Stop(Reason.TEMPERATURE, "l_knee: 71 degrees C", 1.0)
CONDITION = Condition(name="robot before", policy=None)


class _WarmingPlant(ScriptedPlant):
  """A virtual robot that begins so many trials and is then stopped; a trial lasts 20 s."""

  name = "virtual"

  def __init__(self, begins, stop=HOT):
    super().__init__([FAR] * 3)
    self.begins, self.stop, self.time = begins, stop, 5.0
    self.robot = SimpleNamespace(clock=SimpleNamespace(now=lambda: self.time))

  @property
  def environment(self):
    return SimpleNamespace(stop=self.stop if self.started == self.begins else None)

  def start(self, trial):
    if self.started == self.begins:
      raise SafetyError("Torque was switched off: temperature (l_knee: 71 degrees C).")
    self.time += 20.0
    return super().start(trial)


class _StoppingPlant(_WarmingPlant):
  """One whose heat stops the last of the trials that it begins; it could begin more."""

  def start(self, trial):
    self.time += 20.0
    return ScriptedPlant.start(self, trial)

  def stopped(self):
    return f"{HOT.reason}: {HOT.detail}" if self.started == self.begins else ""


def _run(folder, monkeypatch, plants, count=5):
  """Runs trials on plants one after another; returns the ages of their batteries, and lines."""
  ages, said, left = [], [], iter(plants)

  def make(settings, condition, scene, policy, on_robot):
    ages.append(on_robot.seconds)
    return next(left)

  monkeypatch.setattr(trials, "_make_plant", make)
  settings = LoopSettings(out=folder, policy="walker", trials=count)
  from nerf2real.suite.scene import open_scene

  store = Store(folder)
  try:
    found = trials.run(settings, CONDITION, open_scene(None), store, said.append)
  finally:
    episodes = store.episodes
  assert found == episodes
  return settings, ages, said


def test_a_battery_goes_on_where_an_interrupted_run_left_it(tmp_path):
  session = Session(tmp_path, "robot_before")
  assert session.seconds == 0.0 and session.cooled == []
  session.note(20.0)
  session.note(31.0)
  again = Session(tmp_path, "robot_before")
  again.note(10.0)
  assert Session(tmp_path, "robot_before").seconds == 41.0


def test_trials_go_on_with_a_cool_robot_and_the_same_battery(tmp_path, monkeypatch):
  plants = [_WarmingPlant(2), _WarmingPlant(1), _WarmingPlant(9)]
  settings, ages, said = _run(tmp_path, monkeypatch, plants)
  assert [plant.started for plant in plants] == [2, 1, 2] and ages == [0.0, 40.0, 60.0]
  session = trials.session(settings, CONDITION.name)
  assert session.seconds == 100.0
  assert session.cooled == [Cooled(2, "l_knee: 71 degrees C"), Cooled(3, "l_knee: 71 degrees C")]
  assert sum("a session with a cool robot begins" in line for line in said) == 2


def test_a_trial_that_heat_stops_is_followed_by_a_cool_robot(tmp_path, monkeypatch):
  plants = [_StoppingPlant(2), _StoppingPlant(9)]
  settings, _, _ = _run(tmp_path, monkeypatch, plants)
  assert [plant.started for plant in plants] == [2, 3]
  assert trials.session(settings, CONDITION.name).cooled == [Cooled(2, HOT.detail)]
  outcomes = [episode.outcome for episode in Store(tmp_path).episodes]
  assert outcomes.count("stopped") == 1  # the trial itself is lost


def test_no_robot_is_cooled_after_the_last_trial(tmp_path, monkeypatch):
  plant = _StoppingPlant(5)
  _, _, said = _run(tmp_path, monkeypatch, [plant])
  assert plant.started == 5 and not any("cool" in line for line in said)


def test_a_cool_robot_that_cannot_begin_ends_the_loop(tmp_path, monkeypatch):
  plants = [_WarmingPlant(1), _WarmingPlant(0), _WarmingPlant(5)]
  with pytest.raises(RuntimeError, match="found l_knee: 71 degrees C before trial 2 of 5"):
    _run(tmp_path, monkeypatch, plants)
  assert plants[2].started == 0 and len(Store(tmp_path).episodes) == 1


def test_cool_robots_are_taken_so_often_and_no_more(tmp_path, monkeypatch):
  plants = [_WarmingPlant(1) for _ in range(20)]
  with pytest.raises(RuntimeError, match="too much for it"):
    _run(tmp_path, monkeypatch, plants, count=20)
  assert sum(plant.started for plant in plants) == sessions.MOST_COOLED + 1


@pytest.mark.parametrize("stop", [None, Stop(Reason.VOLTAGE, "9.5 V", 1.0)])
def test_another_stop_stays_an_error(tmp_path, monkeypatch, stop):
  with pytest.raises(SafetyError):
    _run(tmp_path, monkeypatch, [_WarmingPlant(1, stop), _WarmingPlant(5)])


def test_a_person_lets_a_real_robot_cool():
  plant = _WarmingPlant(0)
  assert sessions.until_hot(plant, lambda: plant.start(None)) == HOT.detail
  del plant.robot
  with pytest.raises(SafetyError):
    sessions.until_hot(plant, lambda: plant.start(None))
