"""Evaluations and rollouts are filmed, with any policy."""

import json
import shutil
from pathlib import Path

import av
import pytest

from nerf2real import agents, suite
from nerf2real.evaluation import episodes
from nerf2real.launch import rollout, view
from nerf2real.suite import loading


def test_an_evaluation_is_filmed(run, tmp_path):
  arguments = ("--policy", "walker", "--trials", "1", "--time-limit", "0.2")
  ended = run("evaluate", *arguments, "--out", tmp_path, "--video", tmp_path / "trial.mp4")
  assert ended.status == 0, ended
  with av.open(str(tmp_path / "trial.mp4")) as film:
    frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
  assert len(frames) == 4  # eight steps, every second one
  assert frames[0][:360, 480:960].std() > 5  # the robot's picture is there
  (episode,) = episodes.Store(tmp_path).episodes
  assert episode.outcome == "lost" and episode.duration == 0.2


class _LoadedError(Exception):
  """An environment would be loaded now."""


@pytest.mark.parametrize(
  "show",
  [
    lambda policy: rollout.run(rollout.Arguments(policy=policy)),
    lambda policy: view.run(view.Arguments(task="nerf_nav", policy=policy)),
  ],
)
def test_a_policy_is_shown_through_the_camera_it_was_trained_with(show, tmp_path, monkeypatch):
  folder = tmp_path / "policy"
  shutil.copytree(Path(agents.__path__[0]) / "policies" / "nerf_nav", folder)
  record = json.loads((folder / "policy.json").read_text())
  record["environment"] = "suite:nerf_nav?camera_rate=15&camera_gain=2"
  (folder / "policy.json").write_text(json.dumps(record))
  cameras = []

  def load(*_, camera=None, **__):
    cameras.append(camera)
    raise _LoadedError

  monkeypatch.setattr(suite, "load", load)
  monkeypatch.setattr(loading, "load_renderer", lambda _: None)
  with pytest.raises(_LoadedError):
    show(str(folder))
  assert [(camera.rate, camera.gain) for camera in cameras] == [(15, 2)]
