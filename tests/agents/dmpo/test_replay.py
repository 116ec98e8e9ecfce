"""The replay: padding, eviction, what survives on disk, refusals."""

import subprocess

import numpy as np
import pytest

from nerf2real.agents.dmpo.replay.ring import Replay, check_trajectory, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout

LAYOUT = Layout("camera", (4, 5, 3), ("s",), (2,), ("privileged/p",), (3,), 2)
FIELDS = trajectory_fields(LAYOUT, lstm_size=6)
LENGTH = 5


def make_trajectory(steps: int, mark: float = 1.0) -> dict[str, np.ndarray]:
  """A trajectory whose numbers are all `mark`."""
  return {
    name: np.full((steps, *f.shape) if f.per_step else f.shape, mark, f.dtype)
    for name, f in FIELDS.items()
  }


def _replay(folder=None, capacity_steps=12):
  return Replay(FIELDS, length=LENGTH, capacity_steps=capacity_steps, folder=folder)


def test_short_trajectories_are_padded_over_what_was_there():
  replay = _replay(capacity_steps=4)  # one entry
  replay.insert(make_trajectory(5, mark=7))
  replay.insert(make_trajectory(3, mark=2))
  batch = replay.sample(np.random.default_rng(0), 2)
  assert batch["last"].tolist() == [2, 2]
  assert batch["state"].shape == (2, LENGTH, 2) and batch["lstm_hidden"].shape == (2, 6)
  assert (batch["reward"][:, :3] == 2).all() and (batch["reward"][:, 3:] == 0).all()
  assert (batch["image"][:, 3:] == 0).all()


def test_ring_forgets_the_oldest_and_counts_steps():
  replay = _replay()  # 3 entries
  for i, steps in enumerate([5, 4, 3, 2, 5]):
    replay.insert(make_trajectory(steps, mark=i))
  assert (replay.size, replay.steps, replay.inserted) == (3, 2 + 1 + 4, 5)
  marks = replay.sample(np.random.default_rng(0), 200)["reward"][:, 0]
  assert set(marks.tolist()) == {2.0, 3.0, 4.0}
  counts = np.bincount(marks.astype(int))[2:]
  assert counts.min() > 200 / 3 - 30  # uniform: five standard deviations


def test_on_disk_it_survives_without_being_closed(tmp_path):
  replay = _replay(tmp_path)
  for i in range(4):
    replay.insert(make_trajectory(4, mark=i), actor=11, number=i)
  again = _replay(tmp_path)  # as after kill -9: nothing was flushed or closed
  assert (again.size, again.steps, again.inserted) == (3, 9, 4)
  assert sorted(again.origins()) == [(11, 1), (11, 2), (11, 3)]
  again.insert(make_trajectory(5, mark=9), actor=11, number=4)
  assert sorted(n for _, n in again.origins()) == [2, 3, 4]


def test_folder_of_another_shape_is_refused(tmp_path):
  _replay(tmp_path)
  with pytest.raises(ValueError, match="other shapes"):
    _replay(tmp_path, capacity_steps=40)


def test_a_full_disk_is_an_error_and_leaves_what_was_there(tmp_path):
  small = tmp_path / "small"
  small.mkdir()
  mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(small)]
  try:
    subprocess.run(mount, check=True, capture_output=True)
  except (OSError, subprocess.CalledProcessError):
    pytest.skip("needs the right to mount a small disk")
  try:
    replay, number = _replay(small, capacity_steps=40_000), 0
    with pytest.raises(OSError, match="No space left"):
      for number in range(5_000):
        replay.insert(make_trajectory(5, mark=number), number=number)
    assert number > 100 and (replay.size, replay.inserted) == (number, number)
    replay.sample(np.random.default_rng(0), 4)
    del replay
  finally:
    subprocess.run(["umount", str(small)], check=True)


def test_empty_replay_says_so():
  with pytest.raises(ValueError, match="empty"):
    _replay().sample(np.random.default_rng(0), 1)


def _without(trajectory, name):
  return {k: v for k, v in trajectory.items() if k != name}


@pytest.mark.parametrize(
  ("change", "message"),
  [
    (lambda t: _without(t, "action"), "Expected arrays"),
    (lambda t: t | {"action": t["action"].astype(np.float64)}, "action: expected float32"),
    (lambda t: t | {"image": t["image"][:, :3]}, "image: expected uint8"),
    (lambda t: t | {"reward": np.full(4, np.nan, np.float32)}, "not finite"),
    (lambda t: make_trajectory(9), "Expected 2 to 5 steps"),
    (lambda t: make_trajectory(1), "Expected 2 to 5 steps"),
    (lambda t: t | {"reward": np.float32(1)}, "Expected 2 to 5 steps"),
  ],
)
def test_what_does_not_fit_is_refused(change, message):
  good = make_trajectory(4)
  assert check_trajectory(good, FIELDS, length=LENGTH) == 4
  with pytest.raises(ValueError, match=message):
    check_trajectory(change(good), FIELDS, length=LENGTH)
