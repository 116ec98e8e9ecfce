"""The training state: what an update advances, what actors are served, and how a run begins."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerf2real.agents.dmpo import losses, scaling
from nerf2real.agents.dmpo.networks import Params
from nerf2real.agents.dmpo.policy.inference import nest


class TrainingState(NamedTuple):
  """All that an update reads and writes."""

  policy: Params
  target_policy: Params
  critic: Params
  target_critic: Params
  duals: losses.DualParams
  belief: Params  # empty where the environment gives no pose or no pictures
  policy_optimiser: optax.OptState
  critic_optimiser: optax.OptState
  dual_optimiser: optax.OptState
  belief_optimiser: optax.OptState
  scaling: Params  # of the observations; empty without scaling
  steps: jax.Array  # [] int32, updates done
  key: jax.Array  # random key
  student: Params  # policy that the run began with; empty where nothing is drawn to it


def served_parameters(state: TrainingState) -> dict[str, np.ndarray]:
  """What the actors need: the target policy and the belief, as flat named arrays.

  The policy takes observations as they are; the scaling folded into it goes along (`scaling/...`),
  so that training can begin with an exported policy.
  """
  policy = scaling.fold(state.target_policy, state.scaling)
  return flatten_params({"policy": policy, "belief": state.belief, "scaling": state.scaling})


def with_policy(state: TrainingState, parameters: Mapping[str, np.ndarray]) -> TrainingState:
  """Returns a fresh state whose policy and belief are those of an exported policy.

  The head of the standard deviation and all optimisers stay fresh. Where observations are scaled
  and the policy was exported without a scaling, or with that of another critic's observations, its
  first layer is to be rewritten when one is measured (`with_scaling`).

  Args:
    state: a state that has seen no update.
    parameters: flat named arrays, `served_parameters`.

  Raises:
    ValueError: the arrays are not those of this network.
  """
  tree = nest(parameters)
  policy, beliefs, scales = tree["policy"], tree.get("belief", {}), state.scaling
  if scales and _shapes(tree.get("scaling", {})) == _shapes(scales):
    scales = tree["scaling"]
    policy = scaling.unfold(policy, scales)
  policy = policy | {"stddev": state.policy["stddev"]}
  for name, given, wanted in (
    ("policy", policy, state.policy),
    ("belief", beliefs or state.belief, state.belief),
  ):
    found, expected = _shapes(given), _shapes(wanted)
    if found != expected:
      wrong = sorted(k for k in found | expected if found.get(k) != expected.get(k))
      raise ValueError(
        f"The {name} to begin with has other networks than the settings give: {wrong[0]} has the "
        f"shape {found.get(wrong[0])}, expected {expected.get(wrong[0])}. Take the preset and the "
        "--set of the run that made it."
      )
  arrays = jax.tree.map(jnp.array, {"policy": policy, "belief": beliefs or state.belief})
  return state._replace(
    student=jax.tree.map(jnp.copy, arrays["policy"]) if state.student else {},
    policy=arrays["policy"],
    target_policy=jax.tree.map(jnp.copy, arrays["policy"]),
    belief=arrays["belief"],
    scaling=jax.tree.map(jnp.array, scales),
  )


def with_scaling(state: TrainingState, scales: Params, *, keep_policy: bool) -> TrainingState:
  """Returns a state that has seen no update with another scaling.

  Args:
    state: the state.
    scales: from `scaling.measure`.
    keep_policy: rewrites the policies' and the student's first layers so that they act as before; a
      policy with random weights is better left with them, for inputs of one size.
  """
  state = state._replace(scaling=jax.tree.map(jnp.array, scales))
  if not keep_policy:
    return state
  policy, target, student = (
    jax.tree.map(jnp.array, scaling.unfold(p, scales)) if p else p
    for p in (state.policy, state.target_policy, state.student)
  )
  return state._replace(policy=policy, target_policy=target, student=student)


def flatten_params(params: Params, prefix: str = "") -> dict[str, np.ndarray]:
  """Turns nested parameters into {"policy/mlp/layer0/w": array}."""
  flat: dict[str, np.ndarray] = {}
  for name, value in params.items():
    if isinstance(value, Mapping):
      flat |= flatten_params(dict(value), f"{prefix}{name}/")
    else:
      flat[f"{prefix}{name}"] = np.asarray(value)
  return flat


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
  return {name: array.shape for name, array in flatten_params(params).items()}
