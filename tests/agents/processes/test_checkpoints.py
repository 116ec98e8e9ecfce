"""Checkpoints: exact, newest and best, and whole when the disk is full."""

import subprocess

import jax
import numpy as np
import pytest

from nerf2real.agents.dmpo import config, learning, presets
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.processes import checkpoints
from nerf2real.agents.processes.checkpoints import BEST, CheckpointError, Checkpoints

LAYOUT = Layout(None, None, ("s",), (3,), (), (), 2)
WIDTHS = {"network.policy_layers": (64, 64), "network.critic_layers": (64, 64)}


@pytest.fixture(scope="module")
def state():
  settings = config.override(presets.preset("state"), WIDTHS)
  return jax.jit(learning.make_learning(settings, LAYOUT).init)(jax.random.PRNGKey(3))


def _at(state, steps):
  return state._replace(steps=np.int32(steps))


def test_all_of_the_state_comes_back(state, tmp_path):
  saved = Checkpoints(tmp_path)
  saved.save(_at(state, 7), {"steps": 56, "best_return": None})
  other = jax.tree.map(lambda x: np.zeros_like(x), state)
  restored, info = Checkpoints(tmp_path).restore(other)
  assert info == {"steps": 56, "best_return": None}
  assert jax.tree.structure(restored) == jax.tree.structure(state)
  jax.tree.map(np.testing.assert_array_equal, restored, _at(state, 7))


def test_newest_two_and_the_best_are_kept(state, tmp_path):
  saved = Checkpoints(tmp_path)
  for steps in (1, 2, 3):
    saved.save(_at(state, steps), {"steps": steps})
  saved.save(_at(state, 2), {"steps": 2}, kind=BEST)
  saved.save(_at(state, 3), {"steps": 3}, kind=BEST)
  assert [p.name.split("-")[2] for p in saved.list()] == ["000000000002", "000000000003"]
  assert [p.name.split("-")[2] for p in saved.list(BEST)] == ["000000000003"]
  assert saved.restore(state)[1]["steps"] == 3


def test_remains_of_an_interrupted_save_are_ignored_and_removed(state, tmp_path):
  saved = Checkpoints(tmp_path)
  saved.save(_at(state, 1), {"steps": 1})
  remains = tmp_path / "newest-0000000009.orbax-checkpoint-tmp"
  remains.mkdir()
  again = Checkpoints(tmp_path)
  assert again.restore(state)[1]["steps"] == 1
  assert not remains.exists()


def test_none_and_another_shape_are_refused(state, tmp_path):
  saved = Checkpoints(tmp_path)
  with pytest.raises(CheckpointError, match="holds no checkpoint"):
    saved.restore(state)
  saved.save(_at(state, 1), {"steps": 1})
  wide = config.override(presets.preset("state"), WIDTHS | {"network.policy_layers": (32, 32)})
  other = jax.jit(learning.make_learning(wide, LAYOUT).init)(jax.random.PRNGKey(3))
  with pytest.raises(CheckpointError, match="other shapes"):
    saved.restore(other)


def _save_until_full(state, folder):
  saved = Checkpoints(folder)
  for steps in range(1, 20):
    try:
      saved.save(_at(state, steps), {"steps": steps})
    except CheckpointError as error:
      return saved, steps, str(error)
  raise AssertionError("The disk was never full.")


def test_a_full_disk_leaves_the_old_checkpoint_whole(state, tmp_path):
  mount = ["mount", "-t", "tmpfs", "-o", "size=550k", "tmpfs", str(tmp_path)]
  try:
    subprocess.run(mount, check=True, capture_output=True)
  except (OSError, subprocess.CalledProcessError):
    pytest.skip("needs the right to mount a small disk; the next test does without")
  try:
    saved, failed, message = _save_until_full(state, tmp_path)
    assert failed > 1
    assert "the disk is full" in message and f"newest-{failed - 1:010d}" in message
    assert saved.restore(state)[1]["steps"] == failed - 1
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in saved.list()}
  finally:
    # Lazily: threads of the failed save may still hold files.
    subprocess.run(["umount", "-l", str(tmp_path)], check=True)


def test_a_failing_write_leaves_the_old_checkpoint_whole(state, tmp_path, monkeypatch):
  saved = Checkpoints(tmp_path)
  saved.save(_at(state, 1), {"steps": 1})

  def fail(path, args):
    (path.parent / f"{path.name}.orbax-checkpoint-tmp").mkdir()
    raise OSError(28, "No space left on device")

  monkeypatch.setattr(saved._checkpointer, "save", fail)
  with pytest.raises(CheckpointError, match="disk is full.*newest-0000000001"):
    saved.save(_at(state, 2), {"steps": 2})
  assert [p.name for p in tmp_path.iterdir()] == ["newest-0000000001-000000000001-00000000"]
  monkeypatch.undo()
  assert saved.restore(state)[1]["steps"] == 1


def test_info_is_read_without_the_state(state, tmp_path):
  assert checkpoints.read_info(tmp_path) is None
  Checkpoints(tmp_path / "checkpoints").save(_at(state, 1), {"steps": 4})
  assert checkpoints.read_info(tmp_path) == {"steps": 4}


def test_the_time_of_a_run_without_a_step_is_kept(state, tmp_path):
  saved = Checkpoints(tmp_path / "checkpoints")
  for seconds in (0.0, 90.5):
    saved.save(_at(state, 1), {"steps": 4, "seconds": seconds})
  assert checkpoints.read_info(tmp_path)["seconds"] == 90.5


def test_what_changes_within_a_second_is_kept(state, tmp_path):
  saved = Checkpoints(tmp_path / "checkpoints")
  for best in (1.0, 2.0, 2.0, 3.0, 0.5):
    saved.save(_at(state, 1), {"steps": 4, "seconds": 7.3, "best_return": best})
    assert checkpoints.read_info(tmp_path)["best_return"] == best
  names = [p.name for p in saved.list()]
  assert (
    saved.save(_at(state, 1), {"steps": 4, "seconds": 7.9, "best_return": 0.5}).name == names[-1]
  )
  assert [p.name for p in saved.list()] == names
