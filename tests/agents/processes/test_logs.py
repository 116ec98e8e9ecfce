"""The log of a run: a full disk costs rows, and stops nothing."""

import itertools
import json

import pytest
from tensorboardX.event_file_writer import EventsWriter

from nerf2real.agents.processes.logs import MetricsLog


def test_a_full_disk_stops_nothing_and_tensorboard_goes_on_in_another_file(tmp_path, monkeypatch):
  log = MetricsLog(tmp_path)
  log.write("learner", {"loss": 1.0, "note": "x", "bad": float("nan")}, steps=8, updates=1)

  def full(self):
    raise OSError(28, "No space left on device")

  with monkeypatch.context() as patch:
    patch.setattr(EventsWriter, "flush", full)
    for _ in range(30):  # more than any queue would hold
      log.write("learner", {"loss": 2.0}, steps=9, updates=2)
  assert log.failures == 30
  seconds = itertools.count(2_000_000_000)  # a file is named by its second
  monkeypatch.setattr("tensorboardX.event_file_writer.time.time", lambda: next(seconds))
  log.write("actor-0-a", {"return": 3.0}, steps=10, updates=2)
  log.close()
  lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
  assert [line["steps"] for line in lines] == [8, *[9] * 30, 10]
  assert lines[0]["bad"] is None and lines[0]["note"] == "x"
  files = sorted((tmp_path / "tensorboard").iterdir())
  assert len(files) >= 2 and b"actor/return" in files[-1].read_bytes()
  assert b"learner/loss" in files[0].read_bytes()


def test_values_that_are_no_numbers_are_refused(tmp_path):
  with pytest.raises((TypeError, ValueError)):
    MetricsLog(tmp_path).write("learner", {"loss": [1]}, steps=0, updates=0)
