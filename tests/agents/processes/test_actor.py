"""Actor and evaluator without a network: seeds, failing episodes, trials, confirmation."""

import collections
import threading

import numpy as np
import pytest
from dm_control.rl import control

from nerf2real.agents.environments import loading, trials
from nerf2real.agents.processes import actor, evaluator, joining
from nerf2real.launch import actor as command
from tests.agents.processes.stubs import Reach, StubLink, description, documented

CARTPOLE = "dm_control:cartpole:swingup"
Trial = collections.namedtuple("Trial", "wins seed")


def _act(link, *, seed=0, index=0):
  link.process = actor.ActorProcess(link, seed=seed, index=index)
  link.process.run()
  return link.sent


@pytest.fixture(scope="module")
def cartpole():
  return description(loading.make_environment(CARTPOLE, seed=0), CARTPOLE)


@pytest.fixture
def reach(monkeypatch):
  """An environment in place of the one that its name would give."""
  environment = Reach()
  monkeypatch.setattr(joining, "make_environment", lambda name, *, seed, history: environment)
  return environment


def _same(a, b):
  return len(a) == len(b) and all(
    x.keys() == y.keys() and all(np.array_equal(x[k], y[k]) for k in x)
    for x, y in zip(a, b, strict=True)
  )


def test_seed_and_index_decide_the_first_episodes(cartpole):
  first = _act(StubLink(cartpole))
  assert len(first) == 10
  assert _same(first, _act(StubLink(cartpole)))
  for other in (
    _act(StubLink(cartpole), index=1),
    _act(StubLink(cartpole), seed=1),
    _act(StubLink(cartpole, predecessors=1)),  # one that replaces a dead actor
    _act(StubLink(cartpole | {"begin_steps": 80})),  # one of a resumed run
  ):
    assert not np.array_equal(first[0]["state"], other[0]["state"])
    assert not np.array_equal(first[0]["action"], other[0]["action"])


@pytest.mark.parametrize(("given", "seed"), [(None, 5), (3, 3)])
def test_processes_take_the_seed_that_the_learner_says(cartpole, given, seed):
  link = StubLink(cartpole | {"seed": 5})
  arguments = command.Arguments(connect="", index=1, seed=given)
  found = command._process(link, arguments, threading.Event())
  assert found.seed == actor.ActorProcess(link, seed=seed, index=1).seed


def test_a_failing_episode_is_followed_by_another(reach, caplog):
  reach.fail_at = {2, 3, 5}
  link = StubLink(description(reach, "reach"), limit=4)
  assert len(_act(link)) == 4
  assert sum("failed_episode" in r for r in link.reports) == 3
  assert "There is no place left" in caplog.text


def test_several_failing_episodes_in_a_row_end_the_actor(reach):
  reach.fail_at = set(range(2, 100))
  link = StubLink(description(reach, "reach"), limit=100)
  with pytest.raises(joining.EpisodesFailed, match="5 episodes in a row.*There is no place left"):
    _act(link)
  assert len(link.sent) == 1  # what was made before is delivered


def test_steps_before_a_failure_are_delivered(reach, monkeypatch):
  whole, failures = reach.step, [ValueError("broken"), control.PhysicsError("unstable")]

  def step(action):
    if reach._step == 2 and failures:
      raise failures.pop()
    return whole(action)

  monkeypatch.setattr(reach, "step", step)
  link = StubLink(description(reach, "reach"), limit=3)
  assert [t["reward"].shape[0] - 1 for t in _act(link)] == [2, 2, 4]
  assert [set(r) for r in link.reports[:2]] == [{"physics_error"}, {"failed_episode"}]


def test_times_of_the_stages_are_reported(reach):
  reach.task.render_time = 0.0
  whole = reach.step

  def step(action):
    reach.task.render_time += 0.001
    return whole(action)

  reach.step = step
  link = StubLink(description(reach, "reach"), limit=2)
  _act(link)
  seldom = {"localisation_error", "physics_error", "failed_episode"}
  assert {"env_ms", "render_ms", "inference_ms", "waiting_ms"} <= set(link.reports[0])
  assert set(link.reports[0]) | seldom == documented("actor")
  assert link.reports[0]["render_ms"] == pytest.approx(1.0)


def _evaluator(reach, monkeypatch, listed, **changes):
  wrapped = trials.Trials(reach, listed, seed=0)
  monkeypatch.setattr(joining, "make_environment", lambda name, *, seed, history: wrapped)
  link = StubLink(description(reach, "reach", **changes))
  return evaluator.EvaluatorProcess(link, seed=0), link


def test_success_is_measured_on_the_protocol_and_confirmed_on_fresh_trials(reach, monkeypatch):
  listed = [Trial(wins=i % 4 == 0, seed=i) for i in range(8)]  # half of the even ones are won
  process, link = _evaluator(reach, monkeypatch, listed)
  process._evaluate(700)
  first, confirmed = link.reports
  seldom = {"localisation_error", "failed_episode"}
  assert (set(first) - {"at_steps"}) | seldom == documented("evaluator")
  assert (first["success"], first["episodes"], first["confirmation"]) == (0.5, 4, 0)
  assert first["success_low"] == pytest.approx(0.0676, abs=1e-4)  # Clopper and Pearson, 2 of 4
  assert first["success_high"] == pytest.approx(0.9324, abs=1e-4)
  assert (confirmed["success"], confirmed["confirmation"], confirmed["at_steps"]) == (0.0, 1, 700)
  assert [t.seed for t in reach.seen] == [0, 2, 4, 6, 1, 3, 5, 7]
  assert first["length"] == 3.0  # won episodes end at the second of four steps
  process._evaluate(800)
  assert [t.seed for t in reach.seen[8:12]] == [0, 2, 4, 6]  # the same, to be compared


def test_most_trials_are_confirmed_on_those_that_are_left(reach, monkeypatch):
  listed = [Trial(wins=i % 4 == 0, seed=i) for i in range(8)]
  process, link = _evaluator(reach, monkeypatch, listed, evaluation_episodes=6)
  process._evaluate(700)
  assert [t.seed for t in reach.seen] == [0, 1, 2, 4, 5, 6, 3, 7, 3, 7, 3, 7]
  assert [report["episodes"] for report in link.reports] == [6, 6]


def test_only_a_rival_of_the_best_is_confirmed(reach, monkeypatch):
  listed = [Trial(wins=i % 4 == 0, seed=i) for i in range(8)]
  process, link = _evaluator(reach, monkeypatch, listed)
  for best, expected in (
    ({"best_success": 0.75, "best": 0.0}, 1),
    ({"best_success": 0.5, "best": 99.0}, 1),
    ({"best_success": 0.5, "best": 0.0}, 2),  # the return breaks a tie
    ({"best_success": None, "best": None}, 2),
  ):
    link.reports.clear()
    link.status_values = best
    process._evaluate(100)
    assert len(link.reports) == expected


def test_without_success_the_return_is_reported_as_ever(cartpole, monkeypatch):
  link = StubLink(cartpole | {"evaluation_episodes": 1})
  process = evaluator.EvaluatorProcess(link, seed=0)
  process._evaluate(300)
  (figures,) = link.reports
  assert "success" not in figures and figures["episodes"] == 1 and figures["return"] >= 0


def test_failing_evaluations_end_the_evaluator_in_the_end(reach, monkeypatch):
  reach.fail_at = set(range(100))
  process, link = _evaluator(reach, monkeypatch, [Trial(wins=True, seed=0)])
  steps = iter(range(0, 100_000, 100))
  link.request = lambda wanted: {"steps": next(steps), "stop": False, "version": 0}
  with pytest.raises(joining.EpisodesFailed, match="no place left"):
    process.run()
