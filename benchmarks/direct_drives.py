"""Processor time of `launch/identify.py` on two joints with direct drives, logged at 500 Hz.

  python benchmarks/direct_drives.py --write

A double pendulum whose motors take torques holds no position, so that it is simulated in windows;
its readings come five times as often as a servo's. Six logs of 10 s are made by MuJoCo with
an effect that the declared model lacks, a seventh of another motion is held out. Asked: 5 minutes
on 2 cores.
"""

import dataclasses
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

from benchmarks import harness
from benchmarks.ledger.records import ROOT
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log
from nerf2real.suite.effects import Effect, EffectStack

Array = np.ndarray

JOINTS = ("shoulder", "elbow")
MODEL = """
<mujoco model="double_pendulum">
  <option timestep="0.001" integrator="implicitfast"/>
  <default><joint axis="0 1 0" damping="0.01" frictionloss="0.01" armature="0.0005"/></default>
  <worldbody><body name="upper">
    <joint name="shoulder"/>
    <inertial pos="0 0 -0.1" mass="0.5" diaginertia="2e-3 2e-3 1e-4"/>
    <body name="lower" pos="0 0 -0.2">
      <joint name="elbow"/>
      <inertial pos="0 0 -0.08" mass="0.25" diaginertia="6e-4 6e-4 5e-5"/>
    </body>
  </body></worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" forcerange="-4 4"/>
    <motor name="elbow" joint="elbow" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""
HIDDEN = Effect("coulomb_friction", "elbow", {"torque": 0.04})

_PERIOD = 0.002  # s of commands and readings
_COUNT = 2 * np.pi / 2**16  # rad, of an encoder
_STIFFNESS, _DAMPING = np.array([12.0, 3.0]), np.array([0.8, 0.15])  # of the tracking controller
_LATER = 0.0005  # s between a command and the reading after it
_START = 1_700_000_000 * messages.SECOND


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to make and to time."""

  seconds: float = 10.0
  """Of every log."""
  logs: int = 6
  """To identify from."""
  seed: int = 4
  """Of the motions."""
  folder: Path = ROOT / "out/direct_drives"
  """Where logs and findings are written."""


def motion(random: np.random.Generator, seconds: float) -> Array:
  """Returns wanted positions [T, 2] of sums of sines that begin at rest, a row a period."""
  times = np.arange(0.0, seconds, _PERIOD)
  frequencies, phases = random.uniform(0.15, 1.6, (2, 4)), random.uniform(0, 2 * np.pi, (2, 4))
  sizes = random.uniform(0.3, 1.0, (2, 4)) / (1.0 + frequencies)
  waves = sizes[..., None] * np.sin(2 * np.pi * frequencies[..., None] * times + phases[..., None])
  return (np.minimum(times, 1.0) * waves.sum(axis=1)).T


def record(path: Path, wanted: Array) -> None:
  """Writes the log of a machine that follows wanted positions [T, 2] by torques."""
  model = mujoco.MjModel.from_xml_string(MODEL)
  stack, data = EffectStack([HIDDEN]).bind(model), mujoco.MjData(model)
  steps = round(_PERIOD / model.opt.timestep)
  path.parent.mkdir(parents=True, exist_ok=True)
  with open_log(path) as log:
    for index, goal in enumerate(wanted):
      torque = _STIFFNESS * (goal - data.qpos) - _DAMPING * data.qvel
      read = np.round((data.qpos + _LATER * data.qvel) / _COUNT) * _COUNT
      now = _START + round(index * _PERIOD * messages.SECOND)
      log.write(messages.joint_state(now, messages.COMMANDS, JOINTS, effort=torque))
      later = now + round(_LATER * messages.SECOND)
      log.write(messages.joint_state(later, messages.STATES, JOINTS, position=read))
      for _ in range(steps):
        stack.before_step(data, torque)
        mujoco.mj_step(model, data)


def main(settings: Settings) -> None:
  """Makes the logs, identifies and prints the figures."""
  random = np.random.default_rng(settings.seed)
  (settings.folder / "logs").mkdir(parents=True, exist_ok=True)
  model = settings.folder / "model.xml"
  model.write_text(MODEL)
  logs = [settings.folder / "logs" / f"train_{n}.mcap" for n in range(settings.logs)]
  held = settings.folder / "logs" / "held.mcap"
  for path in (*logs, held):
    record(path, motion(random, settings.seconds))
  out = settings.folder / "found"
  command = [sys.executable, str(ROOT / "launch/identify.py"), "--model", str(model)]
  command += ["--logs", *map(str, logs), "--held", str(held), "--out", str(out)]
  before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
  subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
  after = resource.getrusage(resource.RUSAGE_CHILDREN)
  content = json.loads((out / "report.json").read_text())
  found = [f"{e['kind']}@{e['joint']}" for e in content["effects"]]
  row = {
    "processor_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
    "wall_s": time.perf_counter() - began,
    "verdict": content["verdict"],
    "named": ", ".join(found) or "nothing",
    "held_before_mrad": 1e3 * content["error"]["held"]["before"],
    "held_after_mrad": 1e3 * content["error"]["held"]["after"],
    "floor_mrad": 1e3 * content["error"]["floor"],
  }
  values = [
    v for e in content["effects"] if e["kind"] == HIDDEN.kind for v in e["parameters"].values()
  ]
  if values:
    row |= {end: values[0][end] for end in ("value", "low", "high")}
  words = f"Hidden: {HIDDEN.kind} of {HIDDEN.parameters['torque']} N m at the {HIDDEN.target}."
  harness.finish(
    "direct_drives", {"double_pendulum": row}, settings, seed=settings.seed, words=words
  )


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
