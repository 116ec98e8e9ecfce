"""Logs made by MuJoCo itself, with the encoder of a servo: what the analyser should explain.

These tests check arithmetic and plumbing. How well effects are told apart on machines that are not
MuJoCo is measured by `benchmarks/identify.py`.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import JointSeries, Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.model import simulation as evaluation

COUNT = 2 * np.pi / 4096  # rad, of an XM430's encoder

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody><body name="arm">
    <joint name="joint" axis="0 1 0" damping="1.0" armature="0.045" frictionloss="0.03"/>
    <inertial pos="0 0 -0.15" mass="0.5" diaginertia="1e-4 1e-4 1e-4"/>
  </body></worldbody>
  <actuator><position name="joint" joint="joint" kp="21" forcerange="-4 4"/></actuator>
</mujoco>"""

ARM = """
<mujoco model="arm">
  <option timestep="0.001" integrator="implicitfast"/>
  <default><joint damping="1.0" armature="0.045" frictionloss="0.03"/></default>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0"/>
    <inertial pos="0.01 0.02 -0.1" mass="0.4" diaginertia="1e-3 1e-3 2e-4"/>
    <body name="lower" pos="0 0.03 -0.2">
      <joint name="elbow" axis="1 0 0"/>
      <inertial pos="0 0.01 -0.08" mass="0.3" diaginertia="8e-4 8e-4 1e-4"/>
    </body>
  </body></worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="21" forcerange="-4 4"/>
    <position name="elbow" joint="elbow" kp="21" forcerange="-4 4"/>
  </actuator>
</mujoco>"""


def commands(kind: str, duration: float, count: int, *, seed: int = 0) -> tuple:
  """Returns times [T] and commands [T, J]: a sweep, a slow triangle or steps."""
  random = np.random.default_rng(seed)
  time = np.arange(0.0, duration, 0.02)
  ramp = np.minimum(time / 0.5, 1.0)[:, None]
  phase = random.uniform(0, 2 * np.pi, count)
  if kind == "sweep":
    angle = 2 * np.pi * (0.3 * time + 0.5 * 1.5 / duration * time**2)
    wave = np.sin(angle[:, None] + phase)
  elif kind == "slow":
    wave = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.25 * time[:, None] + phase))
  else:
    levels = random.uniform(-1, 1, (int(duration / 1.2) + 2, count))
    wave = levels[(time / 1.2).astype(int)]
  return time, 0.9 * ramp * wave


def log_of(
  xml: str,
  kind: str,
  effects: Sequence[Effect] = (),
  *,
  duration: float = 8.0,
  seed: int = 0,
  rounding: float = COUNT,
) -> Log:
  """Returns a log of a model with effects, positions rounded to the encoder's counts."""
  model = mujoco.MjModel.from_xml_string(xml)
  joints = tuple(model.joint(i).name for i in range(model.njnt))
  time, command = commands(kind, duration, len(joints), seed=seed)
  states = np.arange(0.001, duration - 0.02, 0.01)
  blank = np.zeros((len(states), len(joints)))
  log = Log(
    name=f"{kind}.mcap",
    start_ns=0,
    commands=JointSeries(joints, time, time, command, None, None),
    states=JointSeries(joints, states, states, blank, None, None),
    pwm=None,
    imu=None,
    battery=None,
    temperatures={},
  )
  positions = evaluation.simulate(model, log, effects, window_s=2.0 * duration)  # without restarts
  if rounding:
    positions = np.round(positions / rounding) * rounding
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=positions))


def logs_of(xml: str, effects: Sequence[Effect] = (), *, duration: float = 8.0) -> list[Log]:
  """Returns a sweep, a slow triangle and steps."""
  return [
    log_of(xml, kind, effects, duration=duration, seed=i)
    for i, kind in enumerate(("sweep", "slow", "steps"))
  ]
