"""The floor's slope from the starts of trials: which stop belongs to which trial, and the slope."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from nerf2real.evaluation.loop import naming
from nerf2real.evaluation.loop.robot import starts
from nerf2real.evaluation.loop.robot.starts import Walked
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual import undeclared
from nerf2real.suite.protocols import NAVIGATION
from nerf2real.suite.scene import open_scene
from nerf2real.sysid.sensors.sensed import Estimate, Part, row
from tests.evaluation.fakes import episode

STEP = 0.025


def _commands(*lengths):
  """Returns stamps [s] of a slow move, a stand of 2.7 s, a trial; again for every length [s]."""
  stamps, time = [], 0.0
  for length in lengths:
    stamps += [
      time + STEP * np.arange(60),
      time + 60 * STEP + 2.7 + STEP * np.arange(length / STEP),
    ]
    time += 60 * STEP + 2.7 + length + 1.1  # the last: it is taken hold of
  return SimpleNamespace(commands=SimpleNamespace(stamp=np.concatenate(stamps)))


def _episode(index, duration):
  made = episode("success", index=index)
  setting = dataclasses.replace(made.setting, protocol=NAVIGATION)
  return dataclasses.replace(made, duration=duration, setting=setting)


def test_a_stop_belongs_to_the_trial_that_follows():
  logs = [_commands(5.0, 7.5), _commands(3.0)]
  episodes = [_episode(0, 5.0), _episode(14, 7.5), _episode(28, 3.0)]
  first, second = starts.walks(logs, episodes)
  listed = [trial.yaw for _, trial in plants.trials(NAVIGATION)]
  assert [stop.heading for stop in (*first, *second)] == [listed[i] for i in (0, 14, 28)]
  assert len(first) == 2 and len({stop.heading for stop in first}) == 2
  for stop in (*first, *second):
    assert stop.first - stop.begin == pytest.approx(1.0)
  assert first[0].first == pytest.approx(59 * STEP + 2.725)


def test_a_trial_that_was_cut_short_is_left_out():
  logs = [_commands(5.0, 2.0), _commands(7.5)]  # the second ended with the process
  first, second = starts.walks(logs, [_episode(0, 5.0), _episode(13, 7.5)])
  assert [len(first), len(second)] == [1, 1]
  assert starts.walks(logs, []) == [[], []]


def test_logs_are_read_in_the_order_of_their_numbers(tmp_path):
  names = ("robot_before_10", "robot_before", "robot_before_2", "robot_after")
  for name in names:
    (tmp_path / f"{name}.mcap").touch()
  found = starts.logs(tmp_path, "robot_before")
  assert [path.stem for path in found] == ["robot_before", "robot_before_2", "robot_before_10"]


def test_trials_go_before_turning_where_now_and_before_tell_the_slope(tmp_path, monkeypatch):
  def part(x, estimated=True):
    values = {"x": (x, x - 0.002, x + 0.002), "y": (0.0, -0.002, 0.002)}
    known = {("floor_slope", axis): Estimate(*v, 0.02) for axis, v in values.items()}
    return Part(
      rows=[row("floor_slope", "a", values, 1.0, 1.0)], estimates=known if estimated else {}
    )

  parts = {"now": part(0.05), "before": part(0.0), "none": part(0.0, estimated=False)}
  monkeypatch.setattr(starts, "find", lambda walked: parts[walked])
  monkeypatch.setattr(naming, "_floor", lambda log: part(0.03 if log.parent == tmp_path else 0.0))

  def slope(*walked):
    found = naming._slope(tmp_path, tmp_path / "reference", *walked)
    return [entry["parameters"]["x"]["value"] for entry in found.rows]

  assert slope("now", "before") == [0.05]
  assert slope("now", "none") == slope("none", "before") == slope("now", None) == [0.03]
  assert naming._slope(tmp_path, None, "now", None).rows == parts["now"].rows


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 0.0436])
def test_a_robot_that_begins_trials_on_a_slope_names_it(tmp_path, slope):
  altered = undeclared.parse_all([f"floor_slope:0,{slope}"])
  chosen, episodes = (0, 2, 4, 20), []
  plant = RehearsedPlant(
    open_scene(None),
    EvaluationSettings(plant="virtual"),
    image_size=None,
    altered=altered,
    record=tmp_path / "a.mcap",
  )
  for index in chosen:
    plant.start(plants.trials(NAVIGATION)[index][1])
    for _ in range(60 + index):
      plant.step(plant.environment.standing_action)
    episodes.append(_episode(index, STEP * (60 + index)))
  plant.close()
  found = starts.find(starts.read(Walked(starts.logs(tmp_path, "a"), tuple(episodes))))
  low, high = found.estimates["floor_slope", "y"][1:3]
  assert low <= slope <= high and high - low < 0.02
  assert [effect.kind for effect in found.effects] == (["floor_slope"] if slope else [])
