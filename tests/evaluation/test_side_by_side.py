"""Functions in processes side by side: results, lines, errors, ends."""

import functools
import os
import time

import pytest

from nerf2real.evaluation import session, side_by_side
from nerf2real.evaluation.episodes import Store
from nerf2real.evaluation.settings import EvaluationSettings
from tests.evaluation import side_by_side_functions as functions


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order_and_lines_arrive(processes):
  lines = []
  work = [functools.partial(functions.number_and_process, n) for n in range(3)]
  found = side_by_side.run(work, processes=processes, say=lines.append)
  assert [number for number, _ in found] == [0, 1, 2]
  assert sorted(lines) == ["number 0", "number 1", "number 2"]
  others = {process for _, process in found} - {os.getpid()}
  assert len(others) == (3 if processes == 2 else 0)


def test_an_error_is_raised_and_ends_the_others(tmp_path):
  lines, begun = [], time.monotonic()
  work = [functions.fail, functools.partial(functions.write_late, tmp_path / "late")]
  with pytest.raises(ValueError, match="no such plant"):
    side_by_side.run(work, processes=2, say=lines.append)
  assert lines == ["about to fail"]
  assert time.monotonic() - begun < 20 and not (tmp_path / "late").exists()


def test_a_process_that_was_killed_is_one_line():
  with pytest.raises(RuntimeError, match=r"ended with status -9 .* --processes"):
    side_by_side.run([functions.die, functions.die], processes=2, say=print)


def test_trials_that_are_shared_come_out_as_in_one_process(tmp_path):
  found = []
  for processes in (1, 2):
    settings = EvaluationSettings(
      trials=3, time_limit=0.2, processes=processes, out=tmp_path / str(processes)
    )
    session.evaluate(settings, lambda line: None)
    kept = sorted(Store(settings.out).episodes, key=lambda episode: episode.index)
    found.append([(episode.index, episode.outcome, episode.path) for episode in kept])
  assert found[0] == found[1] and len(found[0]) == 3


def test_processes_share_nothing_that_must_follow_one_another(tmp_path):
  with pytest.raises(ValueError, match="--processes 2 with --plant robot"):
    session.evaluate(EvaluationSettings(plant="robot", processes=2, out=tmp_path), print)
