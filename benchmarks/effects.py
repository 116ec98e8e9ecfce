"""What effects cost a physics step, on 20 joints: `python benchmarks/effects.py`.

Prints the median time of `EffectStack.before_step` for each kind that acts at the physics rate, for
all of them together, and of mj_step beside them. The model is a chain of 20 joints with position
servos, as many as OP3 has.
"""

import time

import mujoco
import numpy as np

from nerf2real.suite.effects import KINDS, Effect, EffectStack

NUM_JOINTS = 20
STEPS = 2000


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


def measure(names: list[str]) -> tuple[float, float]:
  """Returns the median times of before_step and mj_step, microseconds."""
  model = chain()
  stack = EffectStack([strong(name) for name in names]).bind(model)
  data = mujoco.MjData(model)
  phase = np.arange(model.nu)
  ours, theirs = np.empty(STEPS), np.empty(STEPS)
  for index in range(STEPS):
    ctrl = 0.3 * np.sin(0.02 * index + phase)
    start = time.perf_counter()
    stack.before_step(data, ctrl)
    middle = time.perf_counter()
    mujoco.mj_step(model, data)
    ours[index], theirs[index] = middle - start, time.perf_counter() - middle
  return float(np.median(ours)) * 1e6, float(np.median(theirs)) * 1e6


def main() -> None:
  """Prints the table."""
  kinds = [name for name, kind in KINDS.items() if kind.target != "geom"]
  acting = [name for name in kinds if KINDS[name].acts in ("command", "force", "actuator")]
  print(f"{'effects on 20 joints':28s} before_step [us]  mj_step [us]")
  rows = [("none", []), *((name, [name]) for name in acting), ("all kinds", kinds)]
  for label, names in rows:
    ours, theirs = measure(names)
    print(f"{label:28s} {ours:16.1f} {theirs:13.1f}")


if __name__ == "__main__":
  main()
