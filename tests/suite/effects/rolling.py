"""A model with effects stepped through commands."""

import mujoco
import numpy as np


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
