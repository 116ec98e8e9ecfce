"""Time of a policy step on one core.

  python benchmarks/learning/policy.py [--policy runs/x/policy/best]

Without --policy, a policy of the paper's shape with random parameters is exported and loaded, once
for 30x40 and once for 60x80 pictures. Targets: p99 below 10 ms at 30x40, 25 ms at 60x80. Steps take
turns, so that sizes see the same machine; under other load processor time is what to read.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
import tempfile
from pathlib import Path

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real.agents.dmpo.policy.export import ExportedPolicy, load_policy
from nerf2real.core.serialization import to_plain

TARGETS = {(30, 40): 10.0, (60, 80): 25.0}  # ms
# As the suite gives them: 5 steps of 20 joints, 20 previous controls, 3 gyroscope, 3
# accelerometer and 3 gravity numbers, and a goal of 2.
PROPRIOCEPTION = 5 * (20 + 20 + 3 + 3 + 3) + 2
ACTIONS = 20
_WARM_UP = 20  # steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to measure."""

  policy: Path | None = None
  """Folder of an exported policy."""
  steps: int = 1000
  """Steps of each."""


def random_policy(size: tuple[int, int], folder: Path) -> ExportedPolicy:
  """Exports a policy of the paper's shape with random parameters, and loads it."""
  import jax

  from nerf2real.agents.dmpo import networks, presets
  from nerf2real.agents.dmpo.policy.export import export_policy
  from nerf2real.agents.dmpo.specs import Layout
  from nerf2real.agents.dmpo.training_state import flatten_params

  settings = presets.preset("paper")
  layout = Layout("camera", (*size, 3), ("s",), (PROPRIOCEPTION,), (), (), ACTIONS)
  shapes = jax.eval_shape(
    lambda: networks.init_policy(jax.random.PRNGKey(0), settings.network, layout)
  )
  rng = np.random.default_rng(0)
  params = jax.tree.map(lambda x: 0.05 * rng.normal(size=x.shape).astype(np.float32), shapes)
  export_policy(
    folder,
    flatten_params({"policy": params}),
    layout=layout,
    environment="benchmark",
    settings=to_plain(settings),
    info={},
  )
  return load_policy(folder)


class Stepping:
  """A policy that is stepped on random observations of its own shape."""

  def __init__(self, exported: ExportedPolicy):
    rng = np.random.default_rng(0)
    layout, self._policy = exported.layout, exported.policy
    shape = layout.image_shape
    self.name = "state_only" if shape is None else f"{shape[0]}x{shape[1]}"
    self._image = None if shape is None else rng.integers(0, 256, shape, dtype=np.uint8)
    self._state = rng.standard_normal(layout.state_size, np.float32)
    self._memory = self._policy.initial_state()

  def step(self, _: int) -> None:
    """Steps once."""
    self._memory = self._policy.step(self._image, self._state, self._memory).state


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  with tempfile.TemporaryDirectory() as folder:
    exported = (
      [load_policy(settings.policy)]
      if settings.policy
      else [random_policy(size, Path(folder) / str(size[0])) for size in TARGETS]
    )
  policies = [Stepping(policy) for policy in exported]
  times = harness.interleave(
    {policy.name: policy.step for policy in policies}, rounds=settings.steps, warm_up=_WARM_UP
  )
  figures = {
    name: {**t.figures(), "p99_ms": 1e3 * harness.percentile(t.elapsed, 99)}
    for name, t in times.items()
  }
  harness.finish("policy", figures, settings, seed=0)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
