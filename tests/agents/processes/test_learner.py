"""The learner in this process, with one actor in a thread: ends, failures, scaling, best, names."""

import errno
import json
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from nerf2real.agents.dmpo import config, learning, networks, presets, scaling, specs
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.replay.ring import trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link import schema, sessions
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.processes import actor, beginning
from nerf2real.agents.processes.checkpoints import read_info
from nerf2real.agents.processes.learner import Learner, LearnerError
from nerf2real.agents.processes.settings import RunSettings
from nerf2real.agents.supervision.training import free_port
from nerf2real.core.serialization import to_plain
from nerf2real.launch import learner as command
from tests.agents.processes.stubs import documented

ENVIRONMENT = "dm_control:cartpole:swingup"
CONFIG = config.override(
  presets.preset("state"),
  {
    "network.policy_layers": (16, 16),
    "network.critic_layers": (16, 16),
    "batch_size": 4,
    "num_samples": 4,
    "min_replay_steps": 200,
    "scale_observations": True,
  },
)
LINK = sessions.LinkSettings()


def _endpoint():
  return f"tcp/127.0.0.1:{free_port()}"


class Run:
  """A learner; `go` runs it with an actor until it ends."""

  def __init__(self, folder, *, settings=None, resume=False, **run):
    self._endpoint = _endpoint()
    settings = config.override(CONFIG, settings or {})
    run_settings = RunSettings(environment=ENVIRONMENT, run=folder, log_period=0.0, **run)
    self.learner = Learner(
      run_settings, settings, endpoint=self._endpoint, link=LINK, resume=resume
    )

  def go(self):
    session = sessions.connect(self._endpoint, LINK, timeout=30)
    process = actor.ActorProcess(ActorLink(session, LINK, actor="actor-0-t"), seed=0)
    thread = threading.Thread(target=process.run)
    thread.start()
    try:
      self.learner.run()
    finally:
      process.stop()
      thread.join(timeout=10)
      process.link.close()

  def close(self):
    self.learner.stop()
    self.learner.run()


def _rows(folder, source="learner"):
  lines = (folder / "metrics.jsonl").read_text().splitlines()
  return [r for r in map(json.loads, lines) if r["source"].startswith(source)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
  """A run of 400 steps with scaled observations that has ended."""
  folder = tmp_path_factory.mktemp("run")
  run = Run(folder, max_env_steps=400)
  run.go()
  return folder, run.learner


def test_the_fill_pays_for_no_update(finished):
  info = read_info(finished[0])
  assert (info["steps"], info["updates"], info["unpaid_steps"]) == (400, (400 - 200) // 4, 200)


def test_scaling_is_measured_on_the_fill_saved_and_folded(finished, tmp_path):
  folder, learner = finished
  scales = learner._state.scaling
  assert scaling.is_measured(scales)
  assert 0.01 < float(np.min(scales["state"]["stddev"])) < 5.0
  resumed = Run(folder, resume=True)
  np.testing.assert_array_equal(
    resumed.learner._state.scaling["state"]["mean"], scales["state"]["mean"]
  )
  resumed.close()
  observation = np.random.default_rng(0).normal(size=5).astype(np.float32)
  exported = export.load_policy(folder / "policy" / "newest").policy
  step = exported.step(None, observation, exported.initial_state())
  head = networks.policy_head(
    learner._state.target_policy,
    np.zeros(0),
    scaling.apply(scales, "state", observation),
    CONFIG.network,
  )
  np.testing.assert_allclose(step.mean, head.mean, rtol=1e-3, atol=1e-4)


def test_a_run_begins_with_a_policy(finished, tmp_path):
  source = finished[0] / "policy" / "newest"
  run = Run(tmp_path / "run", init_from=source)
  begun = export.load_policy(tmp_path / "run" / "policy" / "newest").policy
  policy, observation = export.load_policy(source).policy, np.full(5, 0.3, np.float32)
  expected = policy.step(None, observation, policy.initial_state()).mean
  found = begun.step(None, observation, begun.initial_state()).mean
  np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
  assert int(run.learner._state.steps) == 0
  assert read_info(tmp_path / "run")["init_from"] == str(source)
  run.close()
  with pytest.raises(ValueError, match="other networks"):
    Run(tmp_path / "other", init_from=source, settings={"network.policy_layers": (8, 8)})


def test_a_run_goes_on_from_a_policy_with_earlier_data(finished, tmp_path):
  """The critic warms up on what it is given, without payment; half of the batches is earlier."""
  source, _ = finished
  earlier = Run(tmp_path / "earlier", max_env_steps=240, replay_on_disk=True)
  earlier.go()
  run = Run(
    tmp_path / "run",
    settings={
      "critic_warmup": 12,
      "student_kl": 0.5,
      "student_kl_updates": 8,
      "steps_per_update": 40,
    },
    init_from=source / "policy" / "newest",
    prior_data=tmp_path / "earlier",
    prior_share=0.5,
    max_env_steps=400,
  )
  learner = run.learner
  policies, shares = [], []
  sample, update = learner._experience.sample, learner._update

  def sampled(rng):
    batch = sample(rng)
    shares.append(len(batch["burn_in"]))
    return batch

  def updated(previous):
    policies.append(jax.device_get(learner._state.policy["mlp"]))
    return update(previous)

  learner._experience.sample, learner._update = sampled, updated
  run.go()
  assert set(shares) == {4}
  same = lambda a, b: all(  # noqa: E731
    np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
  )
  assert all(same(policies[1], p) for p in policies[2:13])  # [0]: before the scaling was measured
  assert not same(policies[1], policies[-1])
  info = read_info(tmp_path / "run")
  assert info["updates"] == 12 + (400 - 200) // 40
  rows = _rows(tmp_path / "run")
  assert "loss_policy" not in rows[0] and rows[-1]["student_weight"] < 0.5
  resumed = Run(tmp_path / "run", settings={"student_kl": 0.5, "critic_warmup": 12}, resume=True)
  assert same(resumed.learner._state.student, learner._state.student)
  resumed.close()


@pytest.mark.parametrize(
  ("settings", "run", "message"),
  [
    ({"student_kl": 1.0}, {}, "student_kl needs a policy to begin with: add --init-from"),
    ({"frozen_encoder": True}, {}, "frozen_encoder needs a policy to begin with"),
    ({}, {"prior_share": 1.5}, "--prior-share must be 0 to 1"),
    ({}, {"prior_data": "nowhere"}, "nowhere holds no prior data"),
    ({}, {"evaluation_period": 0}, "--evaluation-period must be 1 or more, found 0"),
    ({}, {"evaluation_episodes": 0}, "--evaluation-episodes must be 1 or more, found 0"),
  ],
)
def test_a_beginning_that_cannot_be_is_refused(tmp_path, settings, run, message):
  if "prior_data" in run:
    run = {"prior_data": tmp_path / run["prior_data"]}
  with pytest.raises(ValueError, match=message):
    Run(tmp_path / "run", settings=settings, **run)


def test_a_standing_action_is_needed_where_it_is_wanted(tmp_path):
  with pytest.raises(ValueError, match="cartpole.*no standing action"):
    Run(tmp_path, settings={"first_action": "standing"})


def test_minutes_end_a_run_over_all_its_parts(tmp_path):
  run = Run(tmp_path, minutes=1.5 / 60)
  begin = time.monotonic()
  run.go()
  assert time.monotonic() - begin < 60
  seconds = read_info(tmp_path)["seconds"]
  assert seconds >= 1.5
  again = Run(tmp_path, minutes=1.5 / 60, resume=True)
  again.learner.run()  # its time is up
  assert read_info(tmp_path)["updates"] == run.learner.limiter.updates


def test_a_full_disk_ends_the_learner_with_a_reason(tmp_path, monkeypatch):
  run = Run(tmp_path)
  inserted = []

  def insert(trajectory, **origin):
    if len(inserted) == 3:
      raise OSError(errno.ENOSPC, "No space left on device")
    inserted.append(trajectory)

  monkeypatch.setattr(run.learner.replay, "insert", insert)
  begin = time.monotonic()
  with pytest.raises(LearnerError, match="No trajectory can be taken in.*No space left"):
    run.go()
  assert time.monotonic() - begin < 120


def test_steps_are_counted_with_what_the_replay_holds(tmp_path):
  run = Run(tmp_path)
  learner, inserted, counted = run.learner, threading.Event(), threading.Event()
  insert = learner.link._insert

  def insert_slowly(*trajectory):
    steps = insert(*trajectory)
    inserted.set()
    counted.wait(10)
    return steps

  learner.link._insert = insert_slowly
  fields = trajectory_fields(learner.layout, lstm_size=0)
  arrays = {name: np.zeros((5, *field.shape), field.dtype) for name, field in fields.items()}
  values = {"actor": "actor-0-t", "number": 1, "steps": 4}
  message = schema.encode("trajectory", values, arrays)
  taking = threading.Thread(target=learner.link._take_trajectory, args=(message,))
  found = []
  reading = threading.Thread(target=lambda: found.append(learner._info()))
  try:
    taking.start()
    assert inserted.wait(10)
    reading.start()
    reading.join(0.2)  # it waits until the steps are counted, or it would be over
  finally:
    counted.set()
    for thread in (taking, reading):
      thread.join(10)
    run.close()
  assert (found[0]["replay_inserted"], found[0]["steps"]) in ((0, 0), (1, 4))


def _report(learner, **values):
  learner.link.metrics.put(("evaluator-0-x", {"episodes": 27, **values}))
  learner._take_metrics()


def test_best_is_the_most_successful_on_fresh_trials(tmp_path):
  run = Run(tmp_path)
  learner, best = run.learner, tmp_path / "policy" / "best"
  learner.link._held[0] = learner.link._parameters  # as if the evaluator had fetched them
  found = lambda: (learner._best.success, learner._best.best_return)  # noqa: E731
  _report(learner, success=0.9, confirmation=0, version=0, **{"return": 9.0})
  assert learner._best.success is None and not best.exists()
  assert learner._best.evaluated == 9.0
  _report(learner, success=0.4, confirmation=1, version=0, **{"return": 5.0})
  assert found() == (0.4, 5.0) and best.exists()
  _report(learner, success=0.3, confirmation=1, version=0, **{"return": 50.0})
  assert found() == (0.4, 5.0)  # a higher return is not more success
  _report(learner, success=0.4, confirmation=1, version=0, **{"return": 6.0})
  assert found() == (0.4, 6.0)  # the return breaks a tie
  assert learner._status()["best_success"] == 0.4
  assert export.load_policy(best).info["best_success"] == 0.4
  run.close()


def test_best_without_success_is_the_highest_mean_return(tmp_path):
  run = Run(tmp_path)
  run.learner.link._held[0] = run.learner.link._parameters
  for result, expected in ((5.0, 5.0), (4.0, 5.0), (6.0, 6.0)):
    _report(run.learner, confirmation=0, version=0, **{"return": result})
    assert run.learner._best.best_return == expected
    assert read_info(tmp_path)["best_return"] == expected  # also where the learner is killed now
  run.close()


def test_a_policy_that_is_gone_is_no_best(tmp_path):
  """The evaluator had it from a learner that was killed meanwhile."""
  run = Run(tmp_path)
  _report(run.learner, confirmation=0, version=7, **{"return": 99.0})
  assert run.learner._best.evaluated == 99.0
  assert run.learner._best.record()["best_return"] is None
  run.learner.link._held[0] = run.learner.link._parameters
  _report(run.learner, confirmation=0, version=0, **{"return": 5.0})
  assert export.load_policy(tmp_path / "policy" / "best").info["best_return"] == 5.0
  run.close()


def test_a_folder_that_holds_a_run_is_resumed_or_refused(finished):
  """Its checkpoints are newer than the first ones of another run, which would be removed."""
  folder, _ = finished
  before = read_info(folder)
  with pytest.raises(ValueError, match="holds a run: add --resume"):
    Run(folder)
  assert read_info(folder) == before


def test_a_resumed_run_keeps_its_seed(tmp_path):
  Run(tmp_path, seed=5).close()
  assert command.seed_of(command.Arguments(run=tmp_path, resume=True)) == 5
  assert command.seed_of(command.Arguments(run=tmp_path, resume=True, seed=3)) == 3
  assert command.seed_of(command.Arguments(run=tmp_path)) == 0


def test_another_price_of_updates_holds_from_where_a_run_is_resumed(tmp_path):
  settings, replay = RunSettings(environment="", run=tmp_path), SimpleNamespace(on_disk=False)
  replay.steps = CONFIG.min_replay_steps
  info = {"steps": 8200, "refill_until": 200, "unpaid_steps": 200, "config": to_plain(CONFIG)}
  updates = (8200 - 200) // 4
  for price, paid in ((4.0, 8204), (2.0, 8202), (16.0, 8216)):
    limiter = beginning.make_limiter(
      settings,
      config.override(CONFIG, {"steps_per_update": price}),
      replay=replay,
      info=info,
      updates=updates,
    )
    assert not limiter.update_due and limiter.limit <= 8200 + limiter.lead
    limiter.delivered("a", paid - 1 - limiter.steps)
    assert not limiter.update_due
    limiter.delivered("a", 1)
    assert limiter.update_due


def _update_metrics():
  """Names that an update gives with pictures and a belief."""
  layout = Layout("camera", (6, 8, 3), ("s",), (3,), (specs.POSITION, specs.ROTATION), (3, 9), 2)
  settings = config.override(presets.preset("vision_small"), {"student_kl": 0.1})
  functions = learning.make_learning(settings, layout)
  fields = trajectory_fields(layout, lstm_size=settings.network.lstm_size)
  batch = {
    name: jax.ShapeDtypeStruct((2, 6, *f.shape) if f.per_step else (2, *f.shape), f.dtype)
    for name, f in fields.items()
  } | {
    "last": jax.ShapeDtypeStruct((2,), "int32"),
    "student_weight": jax.ShapeDtypeStruct((), "float32"),
  }
  state = jax.eval_shape(functions.init, jax.ShapeDtypeStruct((2,), "uint32"))
  return set(jax.eval_shape(functions.update, state, batch)[1])


ROW = {"time", "source", "steps", "updates"}


def test_the_readme_explains_what_the_learner_logs(finished):
  logged = set().union(*_rows(finished[0])) - ROW
  assert logged | _update_metrics() == documented("learner")
