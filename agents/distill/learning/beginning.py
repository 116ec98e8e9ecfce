"""A student that begins with an exported policy: fine-tuning in place of training from scratch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.distill.learning.updates import TrainingState
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.policy.export import RECORD, read_record
from nerf2real.core.serialization import from_plain

# No export holds these heads.
_FRESH = ("encoder/pose", "encoder/ball", "policy/heads", "policy/stddev")


def agent_of(folder: Path) -> DmpoConfig:
  """Returns the settings, networks included, of an exported policy.

  Raises:
    ValueError: The folder holds none.
  """
  return from_plain(read_record(folder)["settings"], DmpoConfig, source=folder / RECORD)


def begin_with(state: TrainingState, arrays: Mapping[str, np.ndarray]) -> TrainingState:
  """Returns a fresh state whose networks are those of an exported policy.

  The optimisers stay fresh, and the heads that only training has, which `heads` fits to the first
  episodes. The policy is one for observations as they are; `learning.standardised` with
  `keep_policy` rewrites its first layer.

  Args:
    state: a state that has seen no update.
    arrays: flat named arrays of the export.

  Raises:
    ValueError: the arrays are not those of these networks.
  """

  def taken(path: tuple[Any, ...], own: jax.Array) -> jax.Array:
    name = "/".join(str(key.key) for key in path)
    if name.startswith(_FRESH):
      return own
    name = name.replace("encoder/resnet", "policy/resnet")
    if name not in arrays or arrays[name].shape != own.shape:
      found = arrays[name].shape if name in arrays else "nothing"
      raise ValueError(
        f"The policy to begin with has other networks: for {name} found {found}, expected "
        f"{own.shape}; give one that was distilled from pictures, with its own settings."
      )
    return jnp.array(arrays[name])

  return state._replace(student=jax.tree_util.tree_map_with_path(taken, state.student))
