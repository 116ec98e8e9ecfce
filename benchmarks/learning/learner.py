"""Updates a second of this learner beside a plain reference update.

  python benchmarks/learning/learner.py

State-only settings (preset "state") on cartpole's sizes. The reference is DMPO as the public one is
written, with rlax (the test extra): single transitions with n-step rewards summed beforehand, in a
batch of as many transitions, the same networks, samples and optimisers. Both take turns in one run.
--pictures 30x40 60x80 measures the paper's settings instead (no reference), for a GPU; --preset
those of a preset on the observations of `suite:nerf_nav`, both its updates.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks import harness
from nerf2real.agents.dmpo import config, learning, losses, networks, presets
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.replay.features import stored_fields
from nerf2real.agents.dmpo.replay.ring import trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment

STATE_LAYOUT = Layout(None, None, ("position", "velocity"), (3, 2), (), (), 1)
PROPRIOCEPTION, PRIVILEGED, ACTIONS = 247, 70, 20  # about the suite's
_MOST_UPDATES = 100_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to measure."""

  seconds: float = 10.0
  """Time for each."""
  pictures: tuple[str, ...] = ()
  """The paper's settings at these sizes, such as 30x40 60x80."""
  preset: str | None = None
  """This preset on the observations of suite:nerf_nav, such as nerf_nav_finetune."""
  set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
  """NAME=VALUE changes a setting of the agent, such as batch_size=4."""


def random_batch(settings: DmpoConfig, layout: Layout) -> dict[str, Any]:
  """A batch of whole trajectories with random numbers."""
  rng = np.random.default_rng(0)
  lstm = settings.network.lstm_size if layout.image_shape and settings.network.recurrent else 0
  size, time_steps = settings.batch_size, settings.trajectory_length
  batch: dict[str, Any] = {}
  for name, field in stored_fields(trajectory_fields(layout, lstm_size=lstm), settings).items():
    shape = (size, time_steps, *field.shape) if field.per_step else (size, *field.shape)
    if field.dtype == "uint8":
      batch[name] = rng.integers(0, 256, shape, dtype=np.uint8)
    else:
      batch[name] = rng.normal(size=shape).astype(field.dtype)
  batch["discount"][:] = 1.0
  if settings.student_kl:
    batch["student_weight"] = np.float32(settings.student_kl)
  return batch | {"last": np.full(size, time_steps - 1, np.int32)}


def updates(settings: DmpoConfig, layout: Layout, *, name: str = "update") -> Callable[[], None]:
  """A function that does one update of this learner, `update` or `update_critic`."""
  functions = learning.make_learning(settings, layout)
  state = [jax.jit(functions.init)(jax.random.PRNGKey(0))]
  batch, update = random_batch(settings, layout), getattr(functions, name)

  def step() -> None:
    state[0], metrics = update(state[0], batch)
    jax.block_until_ready(metrics["loss"])

  return step


def reference(settings: DmpoConfig, layout: Layout) -> Callable[[], None]:
  """A function that does one plain update on single transitions, with rlax's losses."""
  import rlax

  net = settings.network
  atoms = networks.atoms(net)
  size = settings.batch_size * (settings.trajectory_length - 1)
  rng = np.random.default_rng(0)

  def normal(*shape: int) -> np.ndarray:
    return rng.standard_normal(shape, np.float32)

  batch = {
    "o_tm1": normal(size, layout.state_size),
    "a_tm1": normal(size, layout.action_size),
    "r_t": normal(size),
    "d_t": np.full(size, settings.discount**settings.n_step, np.float32),
    "o_t": normal(size, layout.state_size),
  }
  key = jax.random.PRNGKey(0)
  params = {
    "policy": networks.init_policy(key, net, layout),
    "critic": networks.init_critic(key, net, layout),
    "duals": losses.init_duals(
      layout.action_size, log_temperature=10.0, log_alpha_mean=10.0, log_alpha_stddev=1000.0
    ),
  }
  clip = optax.clip_by_global_norm(settings.max_gradient_norm)
  optimiser = optax.multi_transform(
    {
      "policy": optax.chain(clip, optax.adam(settings.policy_learning_rate)),
      "critic": optax.chain(clip, optax.adam(settings.critic_learning_rate)),
      "duals": optax.adam(settings.dual_learning_rate),
    },
    {"policy": "policy", "critic": "critic", "duals": "duals"},
  )

  def policy(p: Any, observation: jax.Array) -> losses.Gaussian:
    return networks.policy_head(p, jnp.zeros((size, 0)), observation, net)

  def loss(p: Any, target: Any, batch: Any, key: jax.Array) -> jax.Array:
    online, old = policy(p["policy"], batch["o_t"]), policy(target["policy"], batch["o_t"])
    noise = jax.random.normal(key, (settings.num_samples, *old.mean.shape))
    actions = jax.lax.stop_gradient(old.mean + old.stddev * noise)
    probabilities = jax.nn.softmax(networks.critic_logits(target["critic"], batch["o_t"], actions))
    duals = p["duals"]
    fixed = [losses.Gaussian(online.mean, old.stddev), losses.Gaussian(old.mean, online.stddev)]
    log_probs = losses.log_prob(fixed[0], actions) + losses.log_prob(fixed[1], actions)
    penalty = functools.partial(rlax.LagrangePenalty, per_dimension=True)
    constraints = [
      (
        losses.kl_per_dimension(old, fixed[0]),
        penalty(duals.alpha_mean, jnp.asarray(settings.epsilon_mean)),
      ),
      (
        losses.kl_per_dimension(old, fixed[1]),
        penalty(duals.alpha_stddev, jnp.asarray(settings.epsilon_stddev)),
      ),
    ]
    temperature = rlax.LagrangePenalty(duals.temperature, jnp.asarray(settings.epsilon))
    values = jax.lax.stop_gradient(probabilities @ atoms)
    loss_mpo, _ = rlax.mpo_loss(log_probs, values, temperature, constraints, losses.positive)
    cost = losses.out_of_bounds_cost(actions)
    bound = jnp.asarray(settings.epsilon_action_penalty)
    loss_penalty, weights, _ = rlax.mpo_compute_weights_and_temperature_loss(
      cost, rlax.LagrangePenalty(duals.penalty_temperature, bound), losses.positive
    )
    loss_penalty -= jnp.sum(jax.lax.stop_gradient(weights) * log_probs, axis=0)
    positions = batch["r_t"][:, None] + batch["d_t"][:, None] * atoms
    project = jax.vmap(rlax.categorical_l2_project, (0, 0, None))
    wanted = project(positions, probabilities.mean(0), atoms)
    logits = networks.critic_logits(p["critic"], batch["o_tm1"], batch["a_tm1"])
    loss_critic = -jnp.sum(jax.lax.stop_gradient(wanted) * jax.nn.log_softmax(logits), -1)
    return jnp.mean(loss_mpo + loss_penalty + loss_critic)

  @jax.jit
  def update(p: Any, target: Any, state: Any, key: jax.Array) -> Any:
    key, used = jax.random.split(key)
    changes, state = optimiser.update(jax.grad(loss)(p, target, batch, used), state)
    return optax.apply_updates(p, changes), state, key

  carried = [params, optimiser.init(params), key]

  def step() -> None:
    carried[:] = update(carried[0], params, carried[1], carried[2])
    jax.block_until_ready(carried[0])

  return step


def steps_to_time(settings: Settings) -> dict[str, Callable[[], None]]:
  """Returns the updates to time, by name."""
  pairs = (change.partition("=") for change in settings.set)
  changes = {name: json.loads(value) for name, _, value in pairs}
  if settings.pictures:
    agent = config.override(presets.preset("paper"), changes)
    steps = {}
    for size in settings.pictures:
      height, width = map(int, size.split("x"))
      shape, privileged = (height, width, 3), ("privileged/p",)
      layout = Layout(
        "camera", shape, ("s",), (PROPRIOCEPTION,), privileged, (PRIVILEGED,), ACTIONS
      )
      steps[size] = updates(agent, layout)
    return steps
  if settings.preset is not None:
    agent = config.override(presets.preset(settings.preset), changes)
    environment = make_environment("suite:nerf_nav", seed=0)
    layout = Layout.of(environment)
    environment.close()
    names = ("update", "update_critic")
    return {f"{settings.preset}.{name}": updates(agent, layout, name=name) for name in names}
  agent = config.override(presets.preset("state"), changes)
  steps = {"ours": updates(agent, STATE_LAYOUT)}
  try:
    steps["reference"] = reference(agent, STATE_LAYOUT)
  except ImportError:
    print("rlax (the test extra) is not installed: no reference.")
  return steps


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  calls = {name: lambda _, step=step: step() for name, step in steps_to_time(settings).items()}
  times = harness.interleave(calls, rounds=_MOST_UPDATES, seconds=settings.seconds)
  figures = {name: {"updates_per_second": t.rate(), **t.figures()} for name, t in times.items()}
  details = {"device": jax.devices()[0].device_kind}
  harness.finish("learner", figures, settings, seed=0, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
