"""The collector: the mixture over a run, pushes in steps, and labelled episodes."""

import dataclasses
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from nerf2real.agents.distill import schedule, settings
from nerf2real.agents.distill.collecting import collector, episodes, evaluator
from nerf2real.agents.distill.settings import MixtureSettings
from nerf2real.agents.distill.teacher import Label
from nerf2real.agents.dmpo.policy.inference import PolicyState, PolicyStep
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes import joining
from nerf2real.suite import protocols


def test_the_teacher_gives_way_to_the_student():
  mixture = MixtureSettings(first_share=1.0, last_share=0.2, anneal_frames=100, belief_share=0.5)
  assert schedule.mixture_at(mixture, 5_000, begun=None) == (1.0, 0.0)
  assert schedule.mixture_at(mixture, 5_000, begun=5_000) == (1.0, 0.0)
  shared = dataclasses.replace(mixture, first_share=0.6)
  assert schedule.mixture_at(shared, 5_000, begun=None) == (1.0, 0.0)
  assert schedule.mixture_at(shared, 5_000, begun=None, is_borrowed=True) == (0.6, 0.0)
  assert schedule.mixture_at(mixture, 5_050, begun=5_000) == pytest.approx((0.6, 0.25))
  assert schedule.mixture_at(mixture, 9_999, begun=5_000) == pytest.approx((0.2, 0.5))


def test_room_is_left_for_frames_of_students():
  found = dataclasses.replace(settings.preset("tiny"), teacher_frames=100, max_frames=300)
  for frames, begun, expected in (
    (99, None, True),
    (100, None, False),
    (100, 100, True),
    (299, 100, True),
    (300, 100, False),
  ):
    assert schedule.may_collect(found, frames, begun=begun) == expected
  assert settings.nerf_nav().teacher_frames < settings.nerf_nav().max_frames
  assert settings.nerf_nav_60x80().teacher_frames < settings.nerf_nav_60x80().max_frames


@pytest.mark.parametrize("name", ["max_frames", "teacher_frames"])
def test_frames_that_nobody_would_collect_are_refused(name):
  with pytest.raises(ValueError, match=rf"{name} must be 8000 \(first_frames\) or more, found 4"):
    dataclasses.replace(settings.nerf_nav(), **{name: 4_000})


def test_pushes_come_in_steps():
  tiny = settings.preset("tiny")
  assert schedule.push_level(tiny, 39) == (0.0, 0.0)
  assert schedule.push_level(tiny, 40) == (5.0, 15.0)
  name = "suite:nerf_nav?scene=out/room"
  assert schedule.pushed(name, (0.0, 0.0)) == "suite:nerf_nav?scene=out/room&pushes=false"
  assert schedule.pushed("suite:nerf_nav", (1.0, 3.0)) == (
    "suite:nerf_nav?pushes=true&push_force=1.0,3.0"
  )


def test_the_evaluator_reports_success_with_its_interval_and_how_episodes_end(monkeypatch):
  reports, trials = [], []
  task = SimpleNamespace(ending="fall", success=False, success_time=None)
  outcomes = iter([(True, "goal", 5.0), (False, "fall", None), (True, "goal", 7.0)])

  def run(agent, environment):
    task.success, task.ending, task.success_time = next(outcomes)
    return {"return": 1.0, "steps": 4, "success": float(task.success), "localisation_error": 0.1}

  monkeypatch.setattr(evaluator, "run_episode", run)
  monkeypatch.setattr(evaluator, "Agent", lambda *_, **__: None)
  monkeypatch.setattr(evaluator.Policy, "of_network", lambda *_: None)
  found = evaluator.Evaluator.__new__(evaluator.Evaluator)
  found.link, found.layout = SimpleNamespace(report=reports.append), None
  found._settings, found._seed, found._stop = settings.preset("tiny"), 3, threading.Event()
  found._environment, found._chosen = SimpleNamespace(task=task), [0, 1, 2]
  found._trials = SimpleNamespace(choose=lambda chosen, seed: trials.append((chosen, seed)))
  found._evaluate(8, {})
  (report,) = reports
  assert trials == [([0, 1, 2], 3)]
  assert report["episodes"] == 3 and report["success"] == pytest.approx(2 / 3)
  assert report["success_low"] < 0.2 and report["success_high"] > 0.95
  assert (report["falls"], report["collisions"], report["median_time"]) == (1, 0, 6.0)
  assert report["version"] == 8 and report["length"] == 4


def test_an_evaluation_that_fails_is_followed_by_another(monkeypatch):
  """The last of several in a row ends the evaluator; one alone must not, nor its run."""
  reports = []
  link = SimpleNamespace(version=1, report=reports.append, parameters=lambda: (2, {}))
  link.request = lambda wanted: {"stop": False, "version": 2}
  found = evaluator.Evaluator.__new__(evaluator.Evaluator)
  found.link, found._failures = link, joining.Failures(link)
  found._settings = dataclasses.replace(settings.preset("tiny"), evaluation_period=0.0)
  found._stop = threading.Event()
  found._evaluate = lambda version, parameters: 1 / 0
  monkeypatch.setattr(evaluator, "_POLL", 0.0)
  with pytest.raises(joining.EpisodesFailed, match="5 episodes in a row failed.*ZeroDivision"):
    found.run()
  assert reports == [{"failed_episode": 1}] * 5


def test_a_failing_link_is_no_failed_episode():
  reports = []
  found = collector.Collector.__new__(collector.Collector)
  found.link = SimpleNamespace(report=reports.append, drain=lambda timeout: None)
  found._failures, found._stop = joining.Failures(found.link), threading.Event()
  found._ask = lambda: 0

  def episode(frames):
    raise MessageError("refused")

  found._episode = episode
  with pytest.raises(MessageError, match="refused"):
    found.run()
  assert reports == []


def test_trials_during_a_run_are_not_those_that_are_reported():
  reported = protocols.navigation()
  others = evaluator.other_trials(list(reported))
  assert not {t.seed for t in others} & {t.seed for t in reported}
  headings = np.array([[o.yaw - t.yaw for t in reported] for o in others])
  assert np.abs((headings + np.pi) % (2 * np.pi) - np.pi).min() > 1.0
  pushed = evaluator.other_trials(list(protocols.ball_center()))
  assert pushed[0].robot_yaw != protocols.ball_center()[0].robot_yaw


class _Still:
  """A student that stands, and says in which states it was asked."""

  has_belief = True

  def __init__(self, action):
    self._action = action
    self.calls = 0

  def initial_state(self):
    return PolicyState(np.zeros(0), np.zeros(0))

  def belief(self, embedding):
    means = np.array([[0.0, 0.0, 0.0], [9.0, 8.0, 7.0]])
    return np.array([0.0, 1.0]), means, np.ones((2, 3))

  def believed_position(self, embedding):
    return self.belief(embedding)[1].mean(0)[:2]

  def step(self, image, state, carried):
    self.calls += 1
    return PolicyStep(self._action, self._action, np.zeros(0), carried)


class _Teacher:
  """Labels with a constant and notes the poses it is given."""

  def __init__(self):
    self.poses = []

  def reset(self, pose):
    self.poses = []

  def label(self, observation, *, goal, pose, ball=None):
    self.poses.append(pose)
    return Label(np.full(20, 0.5, np.float32), np.array([1.0, -1.0], np.float32))


@pytest.fixture(scope="module")
def world():
  environment = make_environment(settings.preset("tiny").environment + "&pushes=false", seed=0)
  return environment, Layout.of(environment)


def _run(world, mixture, *, policy=None, detours=0.0, covered=0.0):
  environment, layout = world
  teacher = _Teacher()
  runner = episodes.EpisodeRunner(
    environment,
    layout,
    teacher=teacher,
    settings=MixtureSettings(detour_share=detours, segment=(5, 9), covered_share=covered),
    rng=np.random.default_rng(0),
  )
  arrays, figures = runner.run(policy, mixture)
  return arrays, figures, teacher


def test_every_state_is_labelled_whoever_drives(world):
  environment, _ = world
  student = _Still(environment._environment.task.standing_action)
  arrays, figures, teacher = _run(world, schedule.Mixture(0.5, 0.0), policy=student)
  frames = len(arrays["state"])
  assert figures["length"] == frames == student.calls == len(teacher.poses)
  assert set(arrays["driver"]) == {episodes.TEACHER, episodes.STUDENT}
  assert (arrays["label"] == 0.5).all() and (arrays["command"] == [1.0, -1.0]).all()
  assert arrays["pose"] == pytest.approx(np.array(teacher.poses), abs=1e-6)
  goal = environment._environment.task.goal
  expected = np.linalg.norm(arrays["pose"][:, :2] - goal, axis=1)
  assert arrays["goal_distance"] == pytest.approx(expected, abs=1e-4)
  assert arrays["image"].shape == (frames, 12, 16, 3) and arrays["image"].std() > 0
  by_student = arrays["driver"] == episodes.STUDENT
  standing = environment._environment.task.standing_action
  assert arrays["action"][by_student] == pytest.approx(np.tile(standing, (by_student.sum(), 1)))
  terms = environment._environment.task.reward_terms
  assert arrays["reward"][-1] == pytest.approx(terms["total"]) and arrays["reward"].std() > 0
  assert arrays["privileged"].shape == (frames, world[1].privileged_size)
  assert (arrays["discount"][:-1] == 1).all()
  assert arrays["discount"][-1] == float(environment._environment.task.ending is None)


def test_a_teacher_by_belief_is_given_the_likeliest_pose_and_the_truth_is_kept(world):
  environment, _ = world
  student = _Still(environment._environment.task.standing_action)
  arrays, _, teacher = _run(world, schedule.Mixture(0.0, 1.0), policy=student)
  assert set(teacher.poses[1:]) == {(9.0, 8.0, 7.0)}
  assert np.abs(arrays["pose"]).max() < 7.0


def test_without_a_student_the_teacher_drives_and_detours_are_marked(world):
  arrays, figures, _ = _run(world, schedule.Mixture(1.0, 0.0), detours=0.5)
  assert figures["student_share"] == 0
  assert set(arrays["driver"]) == {episodes.TEACHER, episodes.DETOUR}


def test_pictures_are_black_in_some_segments_and_the_rest_is_as_it_was(world):
  student = _Still(world[0]._environment.task.standing_action)
  arrays, _, _ = _run(world, schedule.Mixture(0.0, 0.0), policy=student, covered=0.5)
  is_black = ~arrays["image"].any(axis=(1, 2, 3))
  assert 0 < is_black.mean() < 1
  changes = np.flatnonzero(np.diff(is_black.astype(int)))
  assert (np.diff(changes) >= 5).all()  # whole segments
  assert arrays["state"][is_black].std() > 0 and (arrays["label"] == 0.5).all()
  arrays, _, _ = _run(world, schedule.Mixture(0.0, 0.0), policy=student)
  assert arrays["image"].any(axis=(1, 2, 3)).all()
