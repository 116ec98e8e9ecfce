"""Evaluations and rollouts are filmed, with any policy."""

import av

from nerf2real.evaluation import episodes


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
