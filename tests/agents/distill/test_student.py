"""The student: its export acts as the training network, and its updates reach what they should."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.distill import settings
from nerf2real.agents.distill.learning import student
from nerf2real.agents.distill.learning.updates import make_updates, standardised
from nerf2real.agents.dmpo import scaling
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import POSITION, ROTATION, Layout
from nerf2real.core.serialization import to_plain

LAYOUT = Layout(
  image_name="camera",
  image_shape=(12, 16, 3),
  state_names=("goal", "gyroscope"),
  state_sizes=(2, 3),
  privileged_names=(POSITION, ROTATION),
  privileged_sizes=(3, 9),
  action_size=4,
)
TINY = settings.preset("tiny")


def make_state(seed=0):
  updates = make_updates(TINY, LAYOUT)
  state = updates.init(jax.random.PRNGKey(seed))
  rows = {"state": np.random.default_rng(0).normal(3.0, [1, 5, 0.1, 2, 9], (50, 5))}
  layout = Layout(**{**LAYOUT.__dict__, "privileged_names": (), "privileged_sizes": ()})
  scales = jax.tree.map(jnp.asarray, scaling.measure(rows, layout))
  return updates, state._replace(scales=scales)


def _batch(size=2, time=6, seed=1):
  rng = np.random.default_rng(seed)
  return {
    "image": rng.integers(0, 256, (size, time, 12, 16, 3), np.uint8),
    "state": rng.normal(3.0, 2.0, (size, time, 5)).astype(np.float32),
    "label": rng.uniform(-1, 1, (size, time, 4)).astype(np.float32),
    "command": rng.uniform(-1, 1, (size, time, 2)).astype(np.float32),
    "pose": rng.normal(0, 1, (size, time, 3)).astype(np.float32),
    "goal_distance": np.ones((size, time), np.float32),
    "begins": np.zeros((size, time), np.float32),
  }


def test_the_export_acts_as_the_training_network(tmp_path):
  _, state = make_state()
  batch = _batch()
  batch["begins"][1, 3] = 1.0
  network = TINY.agent.network
  images = batch["image"].reshape(-1, 12, 16, 3).astype(np.float32) / 255
  features = student.encode(state.student["encoder"], images, network).reshape(2, 6, -1)
  found = student.unroll(
    state.student["policy"],
    features=features,
    state=scaling.apply(state.scales, "state", batch["state"]),
    begins=batch["begins"],
    initial=student.initial_state(2, network),
  )
  arrays = student.served_parameters(state.student, state.scales)
  export.export_policy(
    tmp_path,
    arrays,
    layout=LAYOUT,
    environment="suite:nerf_nav",
    settings=to_plain(TINY.agent),
    info={},
  )
  policy = export.load_policy(tmp_path).policy
  assert policy.has_belief and not any("heads" in name for name in arrays)
  for row in range(2):
    carried = policy.initial_state()
    for time in range(6):
      if batch["begins"][row, time]:
        carried = policy.initial_state()
      step = policy.step(batch["image"][row, time], batch["state"][row, time], carried)
      carried = step.state
      assert step.mean == pytest.approx(np.asarray(found.action[row, time]), abs=1e-4)
      assert step.embedding == pytest.approx(np.asarray(found.embedding[row, time]), abs=1e-4)
      assert step.stddev == pytest.approx(network.init_stddev, abs=1e-5)
  assert Policy.of_network(arrays, TINY.agent.network).lstm_size == network.lstm_size


def test_an_unroll_in_two_parts_is_the_unroll_in_one():
  _, state = make_state()
  rng = np.random.default_rng(2)
  features = rng.normal(size=(2, 6, 8)).astype(np.float32)
  inputs = rng.normal(size=(2, 6, 5)).astype(np.float32)
  begins = np.zeros((2, 6), np.float32)

  def run(part, initial):
    return student.unroll(
      state.student["policy"],
      features=features[:, part],
      state=inputs[:, part],
      begins=begins[:, part],
      initial=initial,
    )

  whole = run(slice(0, 6), student.initial_state(2, TINY.agent.network))
  first = run(slice(0, 4), student.initial_state(2, TINY.agent.network))
  second = run(slice(4, 6), first.state)
  assert np.asarray(second.action) == pytest.approx(np.asarray(whole.action[:, 4:]), abs=1e-5)


def test_a_fresh_student_does_what_the_teacher_does_on_average():
  updates = make_updates(TINY, LAYOUT)
  labels = np.random.default_rng(0).normal([0.5, -0.5, 0.0, 0.2], [0.3, 0.001, 0.1, 0.2], (99, 4))
  rows = np.random.default_rng(1).normal(3.0, 2.0, (99, 5))
  state = standardised(
    updates.init(jax.random.PRNGKey(0)),
    state_rows=rows,
    labels=labels.astype(np.float32),
    layout=LAYOUT,
    min_spread=0.05,
  )
  assert state.student["policy"]["mean"]["b"] == pytest.approx(labels.mean(0), abs=1e-6)
  assert state.spread == pytest.approx(np.maximum(labels.std(0), 0.05), abs=1e-6)
  assert state.scales["state"]["mean"] == pytest.approx(rows.mean(0), abs=1e-5)
  assert set(state.scales) == {"state"}


@pytest.mark.parametrize("kind", ["encoder", "policy", "walk", "end_to_end"])
def test_updates_lower_the_loss_and_reach_their_own_parameters(kind):
  updates, state = make_state()
  before = jax.device_get(state.student)
  batch = _batch()
  batch["features"] = np.random.default_rng(3).normal(size=(2, 6, 8)).astype(np.float32)
  carried = student.initial_state(2, TINY.agent.network)
  values = []
  for _ in range(60):
    if kind == "encoder":
      flat = {name: batch[name].reshape(-1, *batch[name].shape[2:]) for name in ("image", "pose")}
      state, metrics = updates.encoder(state, flat, 3e-3)
    else:
      inputs = {k: v for k, v in batch.items() if k != ("image", "features")[kind == "end_to_end"]}
      state, _, metrics = getattr(updates, kind)(state, inputs, carried, 3e-3)
    values.append(float(metrics["loss_encoder" if kind == "encoder" else "loss_action"]))
  assert np.mean(values[-10:]) < 0.8 * np.mean(values[:5])
  after = jax.device_get(state.student)
  moved = {
    name: any(
      not np.array_equal(a, b)
      for a, b in zip(jax.tree.leaves(before[name]), jax.tree.leaves(after[name]), strict=True)
    )
    for name in before
  }
  expected = {
    "encoder": {"encoder"},
    "policy": {"policy", "belief"},
    "walk": {"policy"},
    "end_to_end": set(before),
  }
  assert {name for name, did in moved.items() if did} == expected[kind]
  if kind == "walk":
    lstm = jax.tree.leaves(before["policy"]["lstm"]), jax.tree.leaves(after["policy"]["lstm"])
    assert all(np.array_equal(a, b) for a, b in zip(*lstm, strict=True))


def test_the_walk_alone_learns_after_a_stage_in_which_the_memory_did():
  """Adam goes on along what it remembers of gradients, though there are none any more."""
  updates, state = make_state()
  batch = _batch()
  batch["features"] = np.random.default_rng(3).normal(size=(2, 6, 8)).astype(np.float32)
  carried = student.initial_state(2, TINY.agent.network)
  for _ in range(5):
    state, carried, _ = updates.policy(state, batch, carried, 1e-3)
  before = jax.device_get(state.student)
  for _ in range(3):
    state, carried, _ = updates.walk(state, batch, carried, 1e-3)
  after = jax.device_get(state.student)
  for kept in (lambda found: found["policy"]["lstm"], lambda found: found["belief"]):
    jax.tree.map(np.testing.assert_array_equal, kept(before), kept(after))
  assert not np.array_equal(before["policy"]["mean"]["w"], after["policy"]["mean"]["w"])
