"""What effects cost a physics step, on 20 joints: `python benchmarks/simulation/effects.py`.

Prints the median time of `EffectStack.before_step` for each kind that acts at the physics rate, for
all of them together, and of mj_step beside them. The model is a chain of 20 joints with position
servos, as many as OP3 has.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses

from benchmarks import harness

harness.one_thread()

import mujoco
import numpy as np

from nerf2real.suite.effects import KINDS, Effect, EffectStack

NUM_JOINTS = 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to measure."""

  steps: int = 2000
  """Physics steps of each."""


def chain() -> mujoco.MjModel:
  """Returns ten arms of two joints each, free of contact."""
  arms = "".join(
    f"""<body name="u{i}" pos="{i} 0 0"><joint name="a{i}" axis="0 1 0" damping="1" armature=".045"
    frictionloss=".03"/><geom type="capsule" fromto="0 0 0 0 0 -.1" size=".02" mass=".2"/>
    <body name="f{i}" pos="0 0 -.1"><joint name="b{i}" axis="0 1 0" damping="1" armature=".045"
    frictionloss=".03"/><geom type="capsule" fromto="0 0 0 0 0 -.1" size=".02" mass=".1"/></body>
    </body>"""
    for i in range(NUM_JOINTS // 2)
  )
  servos = "".join(
    f'<position joint="{side}{i}" kp="21" forcerange="-5 5"/>'
    for i in range(NUM_JOINTS // 2)
    for side in "ab"
  )
  return mujoco.MjModel.from_xml_string(
    f'<mujoco><option timestep=".0025" integrator="implicitfast"><flag contact="disable"/></option>'
    f"<worldbody>{arms}</worldbody><actuator>{servos}</actuator></mujoco>"
  )


def strong(name: str) -> Effect:
  """Returns an effect of a kind on all joints, a tenth of its range from nominal."""
  kind = KINDS[name]
  if name == "residual_force":
    return Effect(name, None, {"weights": [0.01] * 25})
  if name == "torque_limit":
    return Effect(name, None, {"limit": 3.0})
  values = {p.name: p.nominal + 0.1 * (p.high - p.low) for p in kind.parameters if not p.shape}
  return Effect(name, "f3" if name == "payload" else None, values)


class Stepping:
  """The chain with effects of some kinds on it."""

  def __init__(self, names: list[str], steps: int):
    self._model = chain()
    self._stack = EffectStack([strong(name) for name in names]).bind(self._model)
    self._data = mujoco.MjData(self._model)
    phase = np.arange(self._model.nu)
    self._controls = [0.3 * np.sin(0.02 * index + phase) for index in range(steps)]

  def before_step(self, index: int) -> None:
    """Applies the effects."""
    self._stack.before_step(self._data, self._controls[index])

  def step(self, _: int) -> None:
    """Steps the physics."""
    mujoco.mj_step(self._model, self._data)


def measure(names: list[str], steps: int) -> dict[str, harness.Value]:
  """Returns the median times of before_step and mj_step [us]."""
  stepping = Stepping(names, steps)
  calls = {"before_step_us": stepping.before_step, "mj_step_us": stepping.step}
  times = harness.interleave(calls, rounds=steps)
  return {name: 1e6 * harness.percentile(t.elapsed, 50) for name, t in times.items()}


def main(settings: Settings) -> None:
  """Measures every kind."""
  kinds = [name for name, kind in KINDS.items() if kind.target != "geom"]
  acting = [name for name in kinds if KINDS[name].acts in ("command", "force", "actuator")]
  rows = {"none": [], **{name: [name] for name in acting}, "all_kinds": kinds}
  figures = {name: measure(kinds_of, settings.steps) for name, kinds_of in rows.items()}
  single = [float(figures[name]["before_step_us"]) for name in acting if name != "backlash"]  # type: ignore[arg-type]
  figures["one_kind"] = {"smallest_us": min(single), "largest_us": max(single)}
  harness.finish("effects", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
