"""Policies are found by name, wherever they lie; what is missing is said in one line."""

import json

import numpy as np
import pytest

from nerf2real.evaluation.policies import names as policy_names
from nerf2real.evaluation.policies.driving import choose_driver
from nerf2real.suite.views import drivers


def _put(folder, environment="suite:nerf_nav?camera_rate=15"):
  folder.mkdir(parents=True)
  record = {name: {} for name in ("layout", "settings", "info", "sha256")}
  record |= {"format_version": 1, "environment": environment}
  (folder / "policy.json").write_text(json.dumps(record))
  return folder


def test_a_policy_of_another_task_is_refused(tmp_path):
  """Both tasks have the same observations: it would act, and fail without a word."""
  pushing = _put(tmp_path / "push", "suite:ball_push?light=true")
  assert policy_names.policy_folder(str(pushing), task="ball_push") == pushing
  with pytest.raises(ValueError, match="was trained on ball_push, found the task nerf_nav"):
    policy_names.policy_folder(str(pushing), task="nerf_nav")
  own = _put(tmp_path / "own", "suite:a_registered_one")
  assert policy_names.policy_folder(str(own), task="nerf_nav") == own


def test_folders_of_runs_and_policies(tmp_path):
  newest = _put(tmp_path / "run" / "policy" / "newest")
  assert policy_names.policy_folder(str(newest), task="nerf_nav") == newest
  assert policy_names.policy_folder(str(tmp_path / "run"), task="nerf_nav") == newest
  best = _put(tmp_path / "run" / "policy" / "best")
  assert policy_names.policy_folder(str(tmp_path / "run"), task="nerf_nav") == best
  with pytest.raises(ValueError, match="Unknown policy 'none': expected walker, shipped, or a"):
    policy_names.policy_folder("none", task="nerf_nav")


def test_shipped_policy_is_found_where_it_is_dropped(tmp_path, monkeypatch):
  monkeypatch.setattr(policy_names.agents, "__path__", [str(tmp_path)])
  with pytest.raises(ValueError, match="No policy shipped for nerf_nav .* --policy walker"):
    policy_names.policy_folder("shipped", task="nerf_nav")
  folder = _put(tmp_path / "policies" / "nerf_nav")
  assert policy_names.policy_folder("shipped", task="nerf_nav") == folder
  larger = _put(tmp_path / "policies" / "nerf_nav_60x80")
  assert policy_names.policy_folder("shipped_60x80", task="nerf_nav") == larger


@pytest.mark.parametrize("name", ["walker", "gait"])
def test_the_walker_has_two_names(name):
  assert choose_driver(name, task="nerf_nav") == ("walker", drivers.Walking, None, None)


class _Task:
  """A task with three goals, at the first of which the robot stands since a time."""

  def __init__(self, since):
    self.outcome = type("Outcome", (), {"success": True, "success_time": 2.0, "duration": since})
    self.goals = np.eye(3, 2)
    self.moved = 0

  def next_goal(self):
    self.moved += 1


@pytest.mark.parametrize(("duration", "moved"), [(2.5, 0), (3.1, 1)])
def test_the_next_goal_comes_a_second_after_one_was_reached(duration, moved):
  task = _Task(duration)
  drivers.move_on(task)
  assert task.moved == moved
