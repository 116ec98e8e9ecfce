"""The data set: files that survive, spans, capacity, streams that carry on."""

import numpy as np
import pytest

from nerf2real.agents.distill.dataset import Dataset, Span, Streams, fields, transition_fields
from nerf2real.agents.dmpo.replay.prior import PriorData
from nerf2real.agents.dmpo.specs import Layout

LAYOUT = Layout(
  image_name="camera",
  image_shape=(2, 2, 3),
  state_names=("goal",),
  state_sizes=(2,),
  privileged_names=(),
  privileged_sizes=(),
  action_size=3,
)


def _episode(frames, value):
  kept = fields(LAYOUT) | transition_fields(LAYOUT)
  return {name: np.full((frames, *shape), value, dtype) for name, (shape, dtype) in kept.items()}


def _open(folder, capacity=100):
  return Dataset(folder, LAYOUT, capacity=capacity, holdout=3)


def test_a_data_set_is_read_again_and_half_written_files_are_not(tmp_path):
  data = _open(tmp_path)
  for number, frames in enumerate((4, 6, 5), start=1):
    assert data.insert(_episode(frames, number), 0xABC, number) == frames
  # What a killed writer leaves: a temporary file beside the whole ones.
  (tmp_path / ".000003_0000000000000abc_4.17-17.partial.npz").write_bytes(b"half")
  again = _open(tmp_path)
  assert again.frames == 15 and again.origins == [(0xABC, 1), (0xABC, 2), (0xABC, 3)]
  assert again.spans(held_out=True) == [Span(4, 10)]
  assert again.spans(held_out=False) == [Span(0, 4), Span(10, 15)]
  for name, (_, dtype) in fields(LAYOUT).items():
    assert again.arrays[name].dtype == dtype
    assert (again.arrays[name][4:10] == 2).all()
  again.insert(_episode(2, 9), 0xABC, 4)
  assert _open(tmp_path).frames == 17


def test_what_does_not_fit_is_refused(tmp_path):
  data = _open(tmp_path, capacity=5)
  with pytest.raises(ValueError, match="lacks \\['label'\\]"):
    data.insert({k: v for k, v in _episode(2, 0).items() if k != "label"}, 1, 1)
  with pytest.raises(ValueError, match="label: expected float32 \\(2, 3\\), found"):
    data.insert(_episode(2, 0) | {"label": np.zeros((2, 4), np.float32)}, 1, 1)
  data.insert(_episode(4, 0), 1, 1)
  with pytest.raises(ValueError, match="holds its 5 frames"):
    data.insert(_episode(2, 0), 1, 2)
  assert data.frames == 4 and len(list(tmp_path.glob("*.npz"))) == 1


def test_the_files_are_prior_data_for_dmpo(tmp_path):
  data = _open(tmp_path)
  sent = _episode(4, 3) | {"reward": np.arange(4, dtype=np.float32)}
  sent["discount"] = np.array([1, 1, 1, 0], np.float32)
  assert data.insert(sent, 1, 1) == 4 and set(data.arrays) == set(fields(LAYOUT))
  prior = PriorData(tmp_path, LAYOUT, max_steps=100)
  assert prior.steps == 4
  batch = prior.sample(np.random.default_rng(0), 3, length=5, burn_in=2, lstm_size=4)
  np.testing.assert_array_equal(batch["reward"][:, :4], np.tile(np.arange(4.0), (3, 1)))
  assert batch["image"].shape == (3, 5, 2, 2, 3) and (batch["action"][:, :4] == 3).all()


def test_episodes_of_an_older_release_are_read_and_no_prior_data(tmp_path):
  _open(tmp_path)
  older = {name: array for name, array in _episode(4, 3).items() if name in fields(LAYOUT)}
  np.savez(tmp_path / "000000_0000000000000abc_1.npz", **older)
  assert _open(tmp_path).frames == 4
  with pytest.raises(ValueError, match="holds no transitions with state, privileged, action"):
    PriorData(tmp_path, LAYOUT, max_steps=100)


def test_a_damaged_file_is_named(tmp_path):
  _open(tmp_path).insert(_episode(2, 0), 1, 1)
  path = next(tmp_path.glob("*.npz"))
  path.write_bytes(path.read_bytes()[:40])
  with pytest.raises(ValueError, match="is no episode of this run"):
    _open(tmp_path)
  path.write_bytes(b"")
  with pytest.raises(ValueError, match="is no episode of this run"):
    _open(tmp_path)
  with pytest.raises(ValueError, match="is no episode"):
    PriorData(tmp_path, LAYOUT, max_steps=100)
  path.rename(tmp_path / "000000.npz")
  np.savez(tmp_path / "000000.npz", **_episode(2, 0))
  with pytest.raises(ValueError, match="000000.npz is no episode of this run"):
    _open(tmp_path)


def test_streams_carry_on_and_say_where_episodes_begin():
  streams = Streams(3, 4, rng=np.random.default_rng(0))
  spans = [Span(0, 5), Span(10, 13)]
  previous = None
  seen = set()
  for _ in range(40):
    unroll = streams.next(spans)
    for row in range(3):
      last = None if previous is None else previous.frames[row, -1]
      for frame, begins in zip(unroll.frames[row], unroll.begins[row], strict=True):
        assert begins == (last is None or frame != last + 1)
        if begins and previous is not None:
          assert frame in (0, 10)  # whole episodes after a stream's first one
          assert last in (4, 12)
        seen.add(int(frame))
        last = frame
    previous = unroll
  assert seen == {*range(5), *range(10, 13)}
