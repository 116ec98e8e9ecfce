"""A hinge, and models with effects stepped through commands."""

import mujoco
import numpy as np

from nerf2real.suite.effects import EffectStack

STEP = 1e-3
INERTIA = 0.01  # kg m^2 of the hinge below


def rollout(stack, data, controls):
  """Steps once for each command [T, U]; returns the bound joints' motion, each [T, J]."""
  binding = stack.binding
  motion = []
  for ctrl in controls:
    stack.before_step(data, ctrl)
    mujoco.mj_step(binding.model, data)
    motion.append((data.qpos[binding.qpos].copy(), data.qvel[binding.dofs].copy()))
  positions, velocities = map(np.array, zip(*motion, strict=True))
  return positions, velocities


def hinge(
  actuator="motor", *, joint="", option='gravity="0 0 0"', inertia=INERTIA, mass=1.0, com="0 0 0"
):
  """One hinge about y. With com at 0 the inertia about it is `inertia`."""
  gain = 'kp="5"' if actuator == "position" else ""
  return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option timestep="{STEP}" integrator="implicitfast" {option}/>
      <worldbody>
        <body name="link" simple="false">
          <joint name="hinge" axis="0 1 0" {joint}/>
          <inertial pos="{com}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
        </body>
      </worldbody>
      <actuator><{actuator} name="drive" joint="hinge" {gain}/></actuator>
    </mujoco>""")


def run(model, effects, controls, *, velocity=0.0, position=0.0):
  stack = EffectStack(effects).bind(model)
  data = mujoco.MjData(model)
  data.qvel[:], data.qpos[:] = velocity, position
  controls = np.asarray(controls, float)
  positions, velocities = rollout(stack, data, controls.reshape(len(controls), model.nu))
  return positions[:, 0], velocities[:, 0], stack, data
