"""Stages are cached by what went in, resume, and never leave half of a result."""

import errno
import shutil

import pytest

from nerf2real.scenes.stages.cache import StageError, Stages


def make(folder):
  return Stages(folder, show_progress=False)


def write_number(number, calls):
  def function(folder, report):
    calls.append(number)
    report(0.5, "half")
    (folder / "number.txt").write_text(str(number))

  return function


def test_second_run_does_nothing(tmp_path):
  calls: list[int] = []
  first = make(tmp_path).run("a", write_number(1, calls), settings={"n": 1}, inputs={})
  second = make(tmp_path).run("a", write_number(1, calls), settings={"n": 1}, inputs={})
  assert calls == [1]
  assert second.cached and not first.cached
  assert second.key == first.key and second.seconds == first.seconds


@pytest.mark.parametrize(
  "changed", [{"settings": {"n": 2}}, {"inputs": {"video": "x"}}, {"version": 2}]
)
def test_other_inputs_make_the_stage_anew(tmp_path, changed):
  calls: list[int] = []
  make(tmp_path).run("a", write_number(1, calls), settings={"n": 1}, inputs={})
  arguments = {"settings": {"n": 1}, "inputs": {}, **changed}
  result = make(tmp_path).run("a", write_number(2, calls), **arguments)
  assert calls == [1, 2]
  assert (result.folder / "number.txt").read_text() == "2"


def test_interrupted_stage_continues_from_its_own_work(tmp_path):
  def interrupted(folder, report):
    (folder / "part").write_text("kept")
    raise KeyboardInterrupt

  with pytest.raises(KeyboardInterrupt):
    make(tmp_path).run("a", interrupted, settings=1, inputs={})
  assert not (tmp_path / "a").exists()
  found = []
  make(tmp_path).run(
    "a", lambda folder, report: found.append((folder / "part").read_text()), settings=1, inputs={}
  )
  assert found == ["kept"]


def test_work_of_other_settings_is_not_mixed_in(tmp_path):
  def interrupted(folder, report):
    (folder / "part").write_text("stale")
    raise KeyboardInterrupt

  with pytest.raises(KeyboardInterrupt):
    make(tmp_path).run("a", interrupted, settings=1, inputs={})
  result = make(tmp_path).run("a", lambda folder, report: None, settings=2, inputs={})
  assert not (result.folder / "part").exists()
  assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_full_disk_is_one_clear_line(tmp_path):
  def full(folder, report):
    raise OSError(errno.ENOSPC, "No space left on device")

  with pytest.raises(StageError, match="full.*free some space"):
    make(tmp_path).run("a", full, settings=1, inputs={})
  assert not (tmp_path / "a").exists()


def test_a_stage_made_again_is_another_one(tmp_path):
  """What depends on a stage whose folder was deleted must not be taken for up to date."""
  first = make(tmp_path).run("a", write_number(1, []), settings=1, inputs={})
  cached = make(tmp_path).run("a", write_number(1, []), settings=1, inputs={})
  shutil.rmtree(first.folder)
  again = make(tmp_path).run("a", write_number(1, []), settings=1, inputs={})
  assert cached.made == first.made
  assert again.key == first.key and again.made != first.made
