"""Every command that writes, on a disk that is full: status 1, one line, whole files or none."""

import errno
import subprocess
import types

import numpy as np
import pytest

from nerf2real.core.robot_logs import streaming
from tests.launch.test_identify import _log
from tests.sysid.synthetic import PENDULUM

_PAGE = 4096  # bytes


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
  """Mounts a disk of 1 MB."""
  folder = tmp_path_factory.mktemp("disk")
  try:
    subprocess.run(
      ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], check=True, capture_output=True
    )
  except (OSError, subprocess.CalledProcessError):
    pytest.skip("needs the right to mount a small disk")
  yield folder
  subprocess.run(["umount", "-l", folder], check=True)


@pytest.fixture
def fill(disk):
  """Leaves so many pages of the empty disk free; returns the disk."""
  filler = disk / "filler"

  def leave(pages):
    with filler.open("wb", buffering=0) as stream:
      try:
        while True:
          stream.write(bytes(_PAGE))
      except OSError as error:
        assert error.errno == errno.ENOSPC
      stream.truncate(max(0, stream.tell() - pages * _PAGE))
    return disk

  yield leave
  subprocess.run(["find", disk, "-mindepth", "1", "-delete"], check=True)


def _expect(ended, disk, *left):
  assert ended.status == 1, ended
  assert "Traceback" not in ended.err + ended.out
  last = ended.err.strip().splitlines()[-1]
  assert last.startswith("error: ") and "disk" in last and str(disk) in last, ended.err
  found = sorted(str(path.relative_to(disk)) for path in disk.rglob("*") if path.is_file())
  assert found == sorted(["filler", *left])
  assert all(path.stat().st_size for path in disk.rglob("*") if path.is_file())


@pytest.fixture
def inputs(tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  _log(tmp_path / "log.mcap")
  return tmp_path


@pytest.mark.parametrize("pages", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_identify(run, fill, inputs, pages, monkeypatch):
  disk = fill(pages)
  if not pages:  # what is found takes seconds to compute, and is not what is tested
    monkeypatch.setattr("nerf2real.sysid.outputs.identify.analyse", lambda *_, **__: pytest.fail())
  arguments = ("--model", inputs / "model.xml", "--logs", inputs / "log.mcap")
  ended = run("identify", *arguments, "--out", disk / "out")
  whole = [] if not pages else ["out/effects.json"]
  _expect(ended, disk, *(name for name in whole if (disk / name).exists()))


def test_evaluate(run, fill):
  disk = fill(1)  # the lock
  arguments = ("--trials", "1", "--time-limit", "0.5", "--policy", "gait")
  _expect(run("evaluate", *arguments, "--out", disk / "out"), disk)


def test_rollout(run, fill):
  disk = fill(1)
  _expect(run("rollout", "--seconds", "0.2", "--video", disk / "video.mp4"), disk)


def test_check_robot(run, fill):
  disk = fill(2)
  arguments = ("--robot", "virtual", "--seconds", "2", "--record", disk / "log.mcap")
  ended = run("check_robot", *arguments)
  kept = (disk / "log.mcap").exists()
  _expect(ended, disk, *(["log.mcap"] if kept else []))
  assert "passed" not in ended.out
  if kept:
    assert "holds what was recorded until then" in ended.err
    assert list(streaming.read_messages(disk / "log.mcap", recover=True))


def test_replay_log(run, fill, inputs):
  disk = fill(2)
  _expect(run("replay_log", inputs / "log.mcap", "--html", disk / "log.html"), disk)


def test_tune_gait(run, fill):
  disk = fill(0)
  arguments = ("--generations", "1", "--population", "2", "--worlds", "1", "--seconds", "0.5")
  _expect(run("tune_gait", *arguments, "--out", disk / "gait.json"), disk)


def test_show_belief(run, fill, monkeypatch):
  disk = fill(0)
  drawn = types.SimpleNamespace(picture=np.zeros((90, 90, 3), np.uint8), errors=[0.1])
  place = "nerf2real.evaluation.report.belief_pictures.draw_episode"
  monkeypatch.setattr(place, lambda *_, **__: drawn)
  _expect(run("show_belief", "policy", "--out", disk / "belief.png"), disk)


def test_calibrate_camera(run, fill, tmp_path, monkeypatch):
  from nerf2real.real.camera import calibration

  disk = fill(0)
  lens = types.SimpleNamespace(
    values=[300.0, 300.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0],
    stddevs=[0.0] * 8,
    width=320,
    height=240,
    views=[],
    rejected=[],
    rms=0.1,
    coverage=1.0,
    camera=None,
  )
  monkeypatch.setattr(calibration, "read_pictures", lambda *_, **__: [])
  monkeypatch.setattr(calibration, "calibrate", lambda *_, **__: lens)
  _expect(run("calibrate_camera", tmp_path, "--out", disk / "camera.yaml"), disk)


def test_film_room(run, fill, monkeypatch):
  from nerf2real.scenes.builtin import filming

  def noise(seed, settings):
    rng = np.random.default_rng(seed)
    for _ in range(settings.frames):
      picture = rng.integers(0, 255, (settings.camera.height, settings.camera.width, 3), np.uint8)
      yield picture, picture, np.eye(4)

  monkeypatch.setattr(filming, "shoot", noise)
  disk = fill(1)
  _expect(run("film_room", "--seconds", "0.2", "--out", disk / "room.mp4"), disk)


@pytest.mark.parametrize("pages", [0, 4])
def test_make_scene(run, fill, pages):
  disk = fill(pages)
  ended = run("make_scene", "--capture", "builtin", "--keyframes", "8", "--out", disk / "out")
  left = [path for path in disk.rglob("*") if path.is_file() and ".stages" in str(path)]
  _expect(ended, disk, *(str(path.relative_to(disk)) for path in left))
  assert not (disk / "out" / "scene.json").exists()


def test_close_loop(run, fill):
  disk = fill(1)
  _expect(run("close_loop", "--out", disk / "out", "--seconds", "1"), disk)


@pytest.mark.parametrize(
  ("script", "arguments"),
  [
    ("local_distributed", ("--env", "agents:cue")),
    ("distill", ("--preset", "tiny")),
    ("learner", ("--env", "agents:cue")),
    ("distill_learner", ("--preset", "tiny")),
  ],
)
def test_runs(run, fill, script, arguments):
  disk = fill(0)
  _expect(run(script, *arguments, "--run", disk / "run"), disk)
