"""The teacher of a loop's training: a walker that copes, or one that is fitted to the effects."""

import types

import numpy as np
import pytest

from nerf2real.agents.distill.teacher import TEACHERS, WalkerTeacher, make_teacher
from nerf2real.evaluation.loop import teachers
from nerf2real.evaluation.plants import plant as plants
from nerf2real.suite.gaits.floor import EmptyFloor

_LOAD = 0.02  # m that the feet must stand to the side of, in these tests


class _Plant:
  time_limit = 20.0


def _episodes(monkeypatch, load, least_height=0.0):
  """Puts a rule in place of the simulation: who stands beside the load falls, sooner if further,
  and so does whose knees are bent too much."""
  seen = []

  def episode(plant, scene, settings, trial, index):
    seen.append(trial)
    off = abs(settings.gait.shift - load)
    duration = float(np.clip(20.0 * (1 - off / 0.03), 1.0, 20.0))
    reached = 0.1 / settings.gait.stride  # s: the longer the stride, the sooner
    success = off < 0.01 and settings.gait.height >= least_height
    return types.SimpleNamespace(success=success, duration=reached if success else duration)

  monkeypatch.setattr(teachers, "_episode", episode)
  monkeypatch.setattr(teachers, "_plant", lambda *_: _Context())
  return seen


class _Context:
  def __enter__(self):
    return _Plant()

  def __exit__(self, *_):
    return False


def test_a_walker_that_copes_is_taken_as_it_is(monkeypatch, tmp_path):
  seen = _episodes(monkeypatch, 0.0)
  found = teachers.choose_teacher(tmp_path, tmp_path / "effects.json", EmptyFloor(), seed=0)
  assert set(found.successes.values()) == {found.trials}
  strides = {name: TEACHERS[name]().gait.stride for name in teachers.WALKERS}
  assert found.teacher == max(strides, key=lambda name: strides[name])  # of equal ones the fastest
  assert len(seen) == len(teachers.WALKERS) * found.trials
  assert not (tmp_path / teachers.ADAPTED).exists()


def test_where_none_copes_one_is_fitted_and_kept(monkeypatch, tmp_path):
  seen = _episodes(monkeypatch, _LOAD)
  found = teachers.choose_teacher(tmp_path, tmp_path / "effects.json", EmptyFloor(), seed=0)
  assert found.successes["fitted"] == found.trials
  assert all(count == 0 for name, count in found.successes.items() if name != "fitted")
  teacher = make_teacher(found.teacher, EmptyFloor())
  assert isinstance(teacher, WalkerTeacher)
  assert teacher._walker._gait.settings.shift == pytest.approx(_LOAD, abs=0.01)
  count = len(seen)
  assert teachers.choose_teacher(tmp_path, tmp_path, EmptyFloor(), seed=0) == found
  assert len(seen) == count  # nothing is run twice


def test_one_that_copes_standing_taller_is_taken_without_a_fit(monkeypatch, tmp_path):
  tallest = {name: TEACHERS[name]().gait.height for name in teachers.WALKERS}
  least = max(tallest.values()) + 0.003
  _episodes(monkeypatch, 0.0, least)
  found = teachers.choose_teacher(tmp_path, tmp_path / "effects.json", EmptyFloor(), seed=0)
  assert "fitted" not in found.successes
  teacher = make_teacher(found.teacher, EmptyFloor())
  assert isinstance(teacher, WalkerTeacher)
  settings = teacher._walker._gait.settings
  assert settings.height >= least
  # Of those that cope the fastest.
  strides = [TEACHERS[name]().gait.stride for name in teachers.WALKERS]
  assert settings.stride == max(strides)


def test_a_fit_meets_no_trial_of_the_protocol(monkeypatch):
  seen = _episodes(monkeypatch, _LOAD)
  teachers.fit(_Plant(), EmptyFloor(), TEACHERS["quick"](), seed=0)
  assert not {trial.seed for trial in seen} & _reported("seed")


def test_a_choice_meets_no_trial_of_the_protocol_and_none_of_the_fit(monkeypatch, tmp_path):
  seen = _episodes(monkeypatch, 0.0)
  found = teachers.choose_teacher(tmp_path, tmp_path / "effects.json", EmptyFloor(), seed=0)
  assert len({trial.seed for trial in seen}) == found.trials
  assert not {trial.seed for trial in seen} & _reported("seed")
  assert not {trial.yaw for trial in seen} & _reported("yaw")
  met = _episodes(monkeypatch, _LOAD)
  for seed in range(3):
    teachers.fit(_Plant(), EmptyFloor(), TEACHERS["quick"](), seed=seed)
  assert not {trial.seed for trial in seen} & {trial.seed for trial in met}


def _reported(name):
  return {getattr(trial, name) for _, trial in plants.trials("navigation")}
