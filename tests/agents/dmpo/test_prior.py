"""Prior data: what a run left is read again, and windows of it are drawn at the asked share."""

import numpy as np
import pytest

from nerf2real.agents.dmpo.replay import prior
from nerf2real.agents.dmpo.replay.prior import PriorData, sample_mixed
from nerf2real.agents.dmpo.replay.ring import Replay, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from tests.agents.dmpo.test_replay import FIELDS, LAYOUT, LENGTH, make_trajectory

ROOM = 10**6


def _counted(steps, *, first=0, fields=FIELDS):
  """A trajectory in which everything at a step is the step's number."""
  numbers = first + np.arange(steps)
  return {
    name: np.broadcast_to(numbers.reshape(-1, *[1] * len(f.shape)), (steps, *f.shape)).astype(
      f.dtype
    )
    if f.per_step
    else np.zeros(f.shape, f.dtype)
    for name, f in fields.items()
  }


def _episodes(folder, episodes, *, layout=LAYOUT):
  folder.mkdir(parents=True, exist_ok=True)
  prior.write_layout(folder, layout)
  for number, episode in enumerate(episodes):
    np.savez(folder / f"{number:06d}_0_1.npz", **episode)
  return folder


def _sample(data, count=400, *, length=LENGTH, burn_in=2, lstm_size=6):
  return data.sample(
    np.random.default_rng(0), count, length=length, burn_in=burn_in, lstm_size=lstm_size
  )


@pytest.fixture
def stored(tmp_path):
  """A run's replay on disk: two full trajectories of an episode, and a short one."""
  folder = tmp_path / "run" / "replay"
  replay = Replay(FIELDS, length=LENGTH, capacity_steps=40, folder=folder)
  prior.write_layout(folder, LAYOUT)
  for first, steps, carried in ((0, 5, 0.0), (4, 5, 0.5), (8, 3, 0.5)):
    trajectory = _counted(steps, first=first)
    trajectory["lstm_cell"] = np.full(6, carried, np.float32)
    replay.insert(trajectory)
  replay.flush()
  return tmp_path / "run"


def test_a_replay_is_read_again_with_zero_states_and_burn_in_within_episodes(stored):
  data = PriorData(stored, LAYOUT, max_steps=ROOM)
  assert data.steps == 4 + 4 + 2
  batch = _sample(data)
  assert set(batch) == {*FIELDS, "last", "burn_in"}
  assert not batch["lstm_hidden"].any() and not batch["lstm_cell"].any()
  first = batch["state"][:, 0, 0]
  assert set(first) == {0, 4, 8}
  np.testing.assert_array_equal(batch["burn_in"], np.where(first == 0, 0, 2))
  np.testing.assert_array_equal(batch["last"], np.where(first == 8, 2, 4))
  real = np.arange(LENGTH) <= batch["last"][:, None]
  np.testing.assert_array_equal(batch["reward"][real], (first[:, None] + np.arange(LENGTH))[real])


def test_every_transition_of_long_episodes_is_drawn_about_alike(tmp_path):
  folder = _episodes(tmp_path / "run" / "data", [_counted(40)])
  data = PriorData(tmp_path / "run", LAYOUT, max_steps=ROOM)
  assert data.steps == 39  # what followed the last action is unknown
  batch = _sample(data, 8_000, length=8)
  counts = np.bincount(batch["state"][:, :7, 0].astype(int).ravel(), minlength=39)
  assert counts[:39].min() > 0.4 * counts.mean() and (batch["last"] == 7).all()
  steps = np.diff(batch["state"][..., 0], axis=1)
  assert (steps == 1).all()
  np.testing.assert_array_equal(batch["burn_in"], np.where(batch["state"][:, 0, 0] == 0, 0, 2))
  assert not _sample(data, lstm_size=0)["burn_in"].any()
  assert folder.exists()


class _Memory:
  """Stands in for a frozen encoder with an LSTM: counts the steps since its state was zero."""

  name, has_memory = "embedding", True

  def encode(self, images):
    return np.broadcast_to(np.arange(len(images))[:, None, None], (len(images), 1, 1))


def test_outputs_of_a_frozen_lstm_are_drawn_where_its_state_is_known(stored):
  data = PriorData(stored, LAYOUT, max_steps=ROOM)
  data.encode(_Memory(), burn_in=2)
  assert data.steps == 4 + 2 + 0  # of the short trajectory only its last observation is left
  batch = _sample(data, lstm_size=0)
  assert "image" not in batch and not batch["burn_in"].any()
  real = np.arange(LENGTH) <= batch["last"][:, None]
  numbers, since = batch["state"][..., 0], batch["embedding"][..., 0, 0]
  assert set(numbers[:, 0]) == {0, 6}
  np.testing.assert_array_equal(since[real], (numbers - 4 * (numbers[:, :1] > 4))[real])
  with pytest.raises(ValueError, match="no transitions beyond the burn-in"):
    short = PriorData(stored, LAYOUT, max_steps=1)
    short.encode(_Memory(), burn_in=2)


def test_a_terminal_transition_is_kept(tmp_path):
  episode = _counted(6)
  episode["discount"] = np.array([1, 1, 1, 1, 1, 0], np.float32)
  data = PriorData(_episodes(tmp_path, [episode]), LAYOUT, max_steps=ROOM)
  assert data.steps == 6
  batch = _sample(data, 100, length=10)
  assert (batch["last"] == 6).all() and (batch["discount"][:, 5] == 0).all()
  assert (batch["state"][:, 6] == 5).all()


def test_the_newest_steps_are_taken(tmp_path):
  folder = _episodes(tmp_path, [_counted(10, first=100 * i) for i in range(5)])
  data = PriorData(folder, LAYOUT, max_steps=12)
  assert data.steps == 18
  assert set(_sample(data)["state"][:, 0, 0] // 100) == {3, 4}


def test_episodes_without_actions_are_left_out_or_refused(tmp_path, caplog):
  labels = {name: a for name, a in _counted(10).items() if name not in ("action", "privileged")}
  data = PriorData(_episodes(tmp_path / "a", [labels, _counted(7)]), LAYOUT, max_steps=ROOM)
  assert data.steps == 6 and "1 episodes lack" in caplog.text
  with pytest.raises(ValueError, match="holds no transitions with state, privileged, action"):
    PriorData(_episodes(tmp_path / "b", [labels]), LAYOUT, max_steps=ROOM)


@pytest.mark.parametrize(
  ("layout", "message"),
  [
    (Layout("camera", (8, 5, 3), ("s",), (2,), ("privileged/p",), (3,), 2), "image_shape is"),
    (Layout("camera", (4, 5, 3), ("t",), (2,), ("privileged/p",), (3,), 2), "state_names is"),
    (Layout("camera", (4, 5, 3), ("s",), (2,), ("privileged/p",), (4,), 2), "privileged_sizes is"),
    (Layout("camera", (4, 5, 3), ("s",), (2,), ("privileged/p",), (3,), 9), "action_size is 9"),
  ],
)
def test_data_of_another_environment_are_refused(tmp_path, layout, message):
  folder = _episodes(tmp_path, [_counted(9)], layout=layout)
  with pytest.raises(ValueError, match=message):
    PriorData(folder, LAYOUT, max_steps=ROOM)
  with pytest.raises(ValueError, match="holds no prior data: expected layout.json"):
    PriorData(tmp_path / "nowhere", LAYOUT, max_steps=ROOM)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 1.0])
def test_batches_hold_the_asked_share(stored, share):
  data = PriorData(stored, LAYOUT, max_steps=ROOM)
  replay = Replay(trajectory_fields(LAYOUT, lstm_size=6), length=LENGTH, capacity_steps=40)
  replay.insert(make_trajectory(LENGTH, mark=77))
  rng = np.random.default_rng(0)
  batches = [
    sample_mixed(replay, data, rng, batch_size=6, share=share, burn_in=2, lstm_size=6)
    for _ in range(300)
  ]
  assert {b["state"].shape for b in batches} == {(6, LENGTH, 2)}
  assert {b["burn_in"].dtype for b in batches} == {np.dtype("int32")}
  found = np.mean([(b["state"][:, 0, 0] != 77).mean() for b in batches])
  assert found == pytest.approx(share, abs=0.02)
