"""The learner: stages over a run, a state that is resumed, and a tiny run end to end."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from nerf2real.agents.distill import schedule, settings
from nerf2real.agents.distill.dataset import Dataset, fields, transition_fields
from nerf2real.agents.distill.learning import checkpoint, student
from nerf2real.agents.distill.learning.learner import Learner
from nerf2real.agents.distill.learning.updates import make_updates
from nerf2real.agents.distill.settings import Stage
from nerf2real.agents.dmpo.policy.export import export_policy, load_policy
from nerf2real.agents.link import sessions
from nerf2real.core.serialization import to_plain
from tests.agents.distill.test_student import LAYOUT, TINY, make_state

SCRIPT = Path(__file__).parents[3] / "launch" / "distill.py"


def test_stages_take_their_shares():
  found = dataclasses.replace(
    TINY, stages=(Stage(kind="encoder", share=0.25), Stage(kind="policy", share=0.75))
  )
  assert schedule.stage_at(found, 0.0) == (0, 0.0)
  assert schedule.stage_at(found, 0.125) == (0, 0.5)
  assert schedule.stage_at(found, 0.25) == (1, 0.0)
  assert schedule.stage_at(found, 1.5) == (1, 1.0)
  assert schedule.cosine(0.0) == 1.0 and schedule.cosine(1.0) == pytest.approx(0.02)
  with pytest.raises(ValueError, match="must sum to 1, found 0.5"):
    dataclasses.replace(TINY, stages=(Stage(kind="policy", share=0.5),))


def test_a_state_is_read_as_it_was_written(tmp_path):
  updates = make_updates(TINY, LAYOUT)
  state = updates.init(jax.random.PRNGKey(3))
  counters = checkpoint.Counters(updates=7, elapsed=12.5, begun=900)
  checkpoint.save_state(tmp_path / "state.npz", state, counters)
  fresh = updates.init(jax.random.PRNGKey(4))
  found, read = checkpoint.load_state(tmp_path / "state.npz", like=fresh)
  assert read == counters
  assert jax.tree.structure(found) == jax.tree.structure(state)
  for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(state), strict=True):
    assert np.array_equal(a, b)
  other = make_updates(settings.nerf_nav(), LAYOUT).init(jax.random.PRNGKey(0))
  with pytest.raises(ValueError, match="of other networks"):
    checkpoint.load_state(tmp_path / "state.npz", like=other)


@pytest.mark.parametrize("size", [0, 10, 2000])
def test_a_saved_state_that_was_cut_off_is_one_line(tmp_path, size):
  state, path = {"a": np.arange(1000.0)}, tmp_path / "state.npz"
  checkpoint.save_state(path, state, checkpoint.Counters())
  path.write_bytes(path.read_bytes()[:size])
  for read in (checkpoint.load_counters, lambda path: checkpoint.load_state(path, like=state)):
    with pytest.raises(ValueError, match=r"state.npz is damaged \(") as found:
      read(path)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
  ("kind", "stopped", "given"),
  [("policy", False, True), ("policy", True, False), ("encoder", False, False)],
)
def test_a_policy_stage_that_ends_before_it_settled_gives_its_student(kind, stopped, given):
  """A slow machine has fewer updates in its minutes: they must not end without a policy."""
  learner, saved = object.__new__(Learner), []
  learner._settings = dataclasses.replace(
    TINY, stages=(Stage(kind=kind, share=1.0),), settling=1_000_000
  )
  learner._minutes, learner._counters = 1e-6, checkpoint.Counters()
  learner._stop, learner._recent, learner._compiled = threading.Event(), [], set()
  learner._data, learner._is_fit = SimpleNamespace(frames=12), False
  learner._trainer = SimpleNamespace(begin_stage=lambda kind: None, update=lambda within: {})
  learner._housekeeping = lambda kind: learner._stop.set() if stopped else None
  learner._publish, learner._save = lambda: None, lambda: saved.append(learner._is_fit)
  learner._run_stage(0)
  assert saved == [given]
  assert learner._counters.begun == (12 if given else None)


def test_a_stop_is_heeded_while_views_are_rendered(tmp_path, monkeypatch):
  """Thousands of views take minutes on a loaded core, which Ctrl-C must not wait for."""
  learner, rendered = object.__new__(Learner), []
  learner._settings = dataclasses.replace(TINY, first_frames=0, views=1000)
  learner._stop, learner._seed, learner._run = threading.Event(), 0, tmp_path
  learner._data, learner._layout = SimpleNamespace(frames=1), None
  learner._periods, learner._set_status = SimpleNamespace(due=lambda *_: True), lambda **_: None
  learner._trainer = SimpleNamespace(views=None, state=SimpleNamespace(scales=None))

  def render(*_, count, report, **__):
    for view in range(count):
      report((view + 1) / count, "rendering views")
      rendered.append(view)
      if view == 2:
        learner.stop()

  monkeypatch.setattr("nerf2real.agents.distill.learning.learner.kept_views", render)
  learner._wait_for_first_frames()
  assert rendered == [0, 1, 2] and learner._trainer.views is None


def test_frames_that_were_labelled_anew_leave_the_student_its_beginning():
  """--relabel fills the data set before the run's own student is there: its share begins then."""
  learner = object.__new__(Learner)
  learner._settings, learner._counters = settings.preset("nerf_nav"), checkpoint.Counters()
  learner._data, learner._publish = SimpleNamespace(frames=150_000), lambda: None
  learner._begin_serving()
  begun, mixture = learner._counters.begun, learner._settings.mixture
  assert schedule.mixture_at(mixture, 150_000, begun=begun).teacher == mixture.first_share == 1.0
  half = schedule.mixture_at(mixture, 150_000 + mixture.anneal_frames // 2, begun=begun).teacher
  assert half == pytest.approx((mixture.first_share + mixture.last_share) / 2)


def test_a_student_is_kept_once_a_period(tmp_path, monkeypatch):
  learner, written = object.__new__(Learner), []
  learner._settings = dataclasses.replace(TINY, keep_minutes=2.0)
  learner._run, learner._is_fit = tmp_path, True
  learner._trainer = SimpleNamespace(state=None)
  learner._publish = lambda: None

  def export(folder):
    folder.mkdir(parents=True, exist_ok=True)
    written.append(folder.name)

  learner._export = export
  monkeypatch.setattr("nerf2real.agents.distill.learning.learner.save_state", lambda *_: None)
  for minutes in (0.5, 1.5, 2.5, 3.9, 6.1):
    learner._counters = checkpoint.Counters(elapsed=60 * minutes)
    learner._save()
  assert written == ["newest", "kept_000", "newest", "newest", "kept_001"] + ["newest"] * 2 + [
    "kept_003"
  ]


class _Link:
  """Takes no episodes and keeps what is served."""

  failure = ""

  def __init__(self, session, settings, *, limiter, **_):
    self.limiter, self.served = limiter, []
    self.set_status = self.take_metrics = self.stop_actors = lambda *_: []

  def publish_parameters(self, arrays, *, version):
    self.served.append(version)


@pytest.fixture
def make_learner(tmp_path, monkeypatch):
  """Makes learners that begin with a policy, in one run's folder with two episodes."""
  environment = SimpleNamespace(close=lambda: None)
  for name, value in {
    "make_environment": lambda name, seed: environment,
    "Layout": SimpleNamespace(of=lambda environment: LAYOUT),
    "LearnerLink": _Link,
    "sessions": SimpleNamespace(listen=lambda endpoint, link: None, LinkSettings=None),
  }.items():
    monkeypatch.setattr(f"nerf2real.agents.distill.learning.learner.{name}", value)
  _, begun = make_state(seed=4)
  source = tmp_path / "policy"
  arrays = student.served_parameters(begun.student, begun.scales)
  about = {"environment": "suite:nerf_nav", "settings": to_plain(TINY.agent), "info": {}}
  export_policy(source, arrays, layout=LAYOUT, **about)
  run, rng = tmp_path / "run", np.random.default_rng(0)
  data = Dataset(run / "data", LAYOUT, capacity=100, holdout=3)
  kept = fields(LAYOUT) | transition_fields(LAYOUT)
  for number in (1, 2):
    data.insert({n: rng.random((20, *s)).astype(d) for n, (s, d) in kept.items()}, 7, number)

  def make(*, resume, seed=0, **changes):
    found = dataclasses.replace(TINY, init_from=str(source), **changes)
    return Learner(
      found, run, endpoint="", link=sessions.LinkSettings(), seed=seed, minutes=1.0, resume=resume
    )

  return make


def test_a_run_goes_on_when_its_last_frame_is_there(make_learner):
  learner = make_learner(resume=False, max_frames=40)
  assert learner._data.frames == 40
  assert not learner._link.limiter.finished  # or the evaluator would leave


def test_a_resumed_run_keeps_its_seed(make_learner):
  assert make_learner(resume=False, seed=5)._seed == 5
  for given, expected in ((None, 5), (3, 3), (None, 3)):
    learner = make_learner(resume=True, seed=given)
    assert learner._seed == learner._counters.seed == expected


def test_a_policy_of_other_observations_is_refused_with_what_differs(make_learner, tmp_path):
  path = tmp_path / "policy" / "policy.json"
  record = json.loads(path.read_text())
  record["layout"]["image_shape"] = [24, 32, 3]
  path.write_text(json.dumps(record))
  with pytest.raises(ValueError, match=r"image_shape is \(24, 32, 3\), this .* \(12, 16, 3\)"):
    make_learner(resume=False)


def test_a_run_with_a_student_of_its_own_goes_on_without_the_policy_it_began_with(
  make_learner, tmp_path
):
  learner = make_learner(resume=False)
  assert learner._link.served == [schedule.BORROWED]
  learner._counters = checkpoint.Counters(updates=5, begun=40)
  learner._save()
  shutil.rmtree(tmp_path / "policy")
  resumed = make_learner(resume=True)
  assert resumed._counters == learner._counters
  assert resumed._link.served == [schedule.BORROWED + 5]


def test_inputs_are_standardised_once_also_where_the_run_stopped_right_after(make_learner):
  """A policy that a run begins with would be rewritten for them twice."""
  learner = make_learner(resume=False)
  learner._wait_for_first_frames()
  learner._save()
  wanted = jax.device_get(learner._trainer.state.student["policy"])
  resumed = make_learner(resume=True)
  resumed._wait_for_first_frames()
  found = jax.device_get(resumed._trainer.state.student["policy"])
  jax.tree.map(np.testing.assert_array_equal, wanted, found)


@pytest.mark.parametrize(("updates", "exports"), [(0, True), (5, False)])
def test_a_resumed_run_that_stops_at_once_gives_no_student_that_may_not_fit(
  make_learner, updates, exports
):
  """It may have been saved while the encoder learned."""
  learner = make_learner(resume=False)
  learner._counters = checkpoint.Counters(updates=updates)
  learner._is_fit = False
  learner._save()
  resumed = make_learner(resume=True)
  resumed.stop()
  resumed.run()
  assert (resumed._run / "policy" / "newest").exists() == exports


def _start(run, *extra):
  command = [sys.executable, str(SCRIPT), "--run", str(run), "--preset", "tiny", *extra]
  environment = os.environ | {"PYTHONPATH": str(SCRIPT.parents[1])}
  return subprocess.Popen(
    command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
  )


@pytest.mark.slow
def test_a_tiny_run_survives_a_kill_and_its_policy_loads(tmp_path):
  run = tmp_path / "run"
  first = _start(run, "--minutes", "0.15")
  deadline = time.monotonic() + 240
  while not (run / "policy").exists() and time.monotonic() < deadline:
    assert first.poll() is None, first.communicate()[0]
    time.sleep(0.2)
  first.send_signal(signal.SIGKILL)
  first.wait()
  time.sleep(2)  # its processes end with it
  kept = sorted(path.name for path in (run / "data").glob("[0-9]*.npz"))
  assert kept
  refused = _start(run, "--minutes", "0.15")
  assert (
    "holds a run: add --resume" in refused.communicate(timeout=240)[0] and refused.returncode == 2
  )
  second = _start(run, "--minutes", "0.15", "--resume")
  output = second.communicate(timeout=400)[0]
  assert second.returncode == 0, output
  assert set(kept) <= {path.name for path in (run / "data").glob("[0-9]*.npz")}
  loaded = load_policy(run / "policy" / "newest")
  assert loaded.policy.has_belief and loaded.info["updates"] > 0
  rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
  assert {row["stage"] for row in rows if "stage" in row} >= {"policy"}
  assert {"learner"} <= {row["source"] for row in rows}
