"""What `launch/identify.py` says of an arm whose links weigh as much as its rotors, from CSV files.

  python benchmarks/coupled_arms.py --write

Plain MuJoCo moves the arm; its two position servos are commanded at 50 Hz, read at 100 Hz with
noise, and its true constants are a few per cent off the declared ones. Each joint feels the other's
acceleration at every jump of a command, which readings show smeared. One change is hidden at a
time; references are three motions of the same arm without it.
"""

import csv
import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from benchmarks import harness
from benchmarks.ledger.records import ROOT

Array = np.ndarray

JOINTS = ("shoulder", "elbow")
DECLARED = {"damping": (0.4, 0.2), "friction": (0.25, 0.12), "stiffness": (60.0, 30.0)}
"""N m s/rad, N m and N m/rad of shoulder and elbow."""
PAYLOAD = '<geom pos="0.18 0 0" size="0.02" mass="0.25" contype="0" conaffinity="0"/>'
LATE = 0.024  # s
RUBS = 0.2  # N m more at the elbow
STRETCHED, REST = 3.0, 0.2  # N m/rad and rad of a spring at the elbow
SOFTER = 0.75  # of the shoulder's gain for position; its servo's own damping stays
HIDDEN = ("nothing", "payload", "late commands", "friction", "spring", "position gain")

_STEP, _COMMAND, _READING = 0.002, 10, 5  # s, and steps between commands and readings
_SECONDS, _SETTLING = 14.0, 3.0
_NOISE = 3e-4  # rad
_TOLERANCE = 0.02  # of the true constants

Force = Callable[[mujoco.MjData], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to make and to identify."""

  hidden: tuple[str, ...] = HIDDEN
  """Changes, of `HIDDEN`."""
  seed: int = 1
  """Of motions, noise and true constants; one more for each change."""
  folder: Path = ROOT / "out/coupled_arms"
  """Where logs and findings are written."""


def arm(constants: Mapping[str, tuple[float, ...]], load: str = "") -> str:
  """Returns the MJCF of an arm with constants of its two joints and more on its forearm."""
  (d1, d2), (f1, f2), (k1, k2) = (constants[name] for name in DECLARED)
  return f"""
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="{_STEP}" integrator="implicitfast"/>
  <default>
    <joint axis="0 1 0" range="-2.5 2.5"/>
    <geom type="capsule" contype="0" conaffinity="0"/>
  </default>
  <worldbody><body name="upper" pos="0 0 1">
    <joint name="shoulder" damping="{d1}" armature="0.03" frictionloss="{f1}"/>
    <geom fromto="0 0 0 0.25 0 0" size="0.03" mass="1.1"/>
    <body name="fore" pos="0.25 0 0">
      <joint name="elbow" damping="{d2}" armature="0.015" frictionloss="{f2}"/>
      <geom fromto="0 0 0 0.2 0 0" size="0.025" mass="0.6"/>
      {load.replace("<geom", '<geom type="sphere"')}
    </body>
  </body></worldbody>
  <actuator>
    <position joint="shoulder" kp="{k1}" kv="1.5" forcerange="-18 18"/>
    <position joint="elbow" kp="{k2}" kv="0.6" forcerange="-8 8"/>
  </actuator>
</mujoco>
"""


def commands(kind: str, random: np.random.Generator) -> Array:
  """Returns commanded positions [T, 2] of a sweep, a slow motion or steps, a row a step."""
  time = _STEP * np.arange(round(_SECONDS / _STEP))
  begin, columns = np.minimum(time, 1.0), []
  for joint in range(2):
    if kind == "sweep":
      angle = 2 * np.pi * _STEP * np.cumsum(0.2 * 12.5 ** (time / _SECONDS))
      columns.append(0.35 * begin * np.sin(angle + 1.3 * joint))
    elif kind == "slow":
      wave = 0.7 * np.sin(2 * np.pi * 0.15 * time + joint) + 0.1 * np.sin(2 * np.pi * 0.7 * time)
      columns.append(begin * wave)
    else:
      levels = random.uniform(-0.8, 0.8, 30)
      columns.append(levels[(time / 1.1).astype(int)] * (time > 0.5))
  wanted = np.array(columns).T
  return wanted[np.arange(len(time)) // _COMMAND * _COMMAND]


def record(
  path: Path, xml: str, wanted: Array, random: np.random.Generator, late: float, force: Force | None
) -> None:
  """Writes what an arm does under commands [T, 2] that reach it late, from rest at their first."""
  model = mujoco.MjModel.from_xml_string(xml)
  data, behind = mujoco.MjData(model), round(late / _STEP)
  data.qpos[:] = data.ctrl[:] = wanted[0]
  for _ in range(round(_SETTLING / _STEP)):
    mujoco.mj_step(model, data)
  path.parent.mkdir(parents=True, exist_ok=True)
  with path.open("w", newline="") as file:
    table = csv.writer(file)
    topics = ("command_position", "position")
    table.writerow(["time", *(f"{topic}:{joint}" for topic in topics for joint in JOINTS)])
    for n, now in enumerate(wanted):
      time = n * _STEP
      if n % _COMMAND == 0:
        table.writerow([f"{time:.4f}", *(f"{value:.6f}" for value in now), "", ""])
      if n % _READING == 0:
        read = data.qpos + random.normal(0.0, _NOISE, 2)
        table.writerow([f"{time + 1e-4:.4f}", "", "", *(f"{value:.6f}" for value in read)])
      data.ctrl[:] = wanted[max(0, n - behind)]
      if force is not None:
        force(data)
      mujoco.mj_step(model, data)


def _spring(data: mujoco.MjData) -> None:
  data.qfrc_applied[1] = -STRETCHED * (data.qpos[1] - REST)


def make(folder: Path, hidden: str, seed: int) -> None:
  """Writes a model, logs with a hidden change, held ones, and references without it."""
  random = np.random.default_rng(seed)
  true = {
    name: tuple(value * (1 + random.uniform(-_TOLERANCE, _TOLERANCE)) for value in values)
    for name, values in DECLARED.items()
  }
  shoulder, elbow = true["friction"]
  changed = true | ({"friction": (shoulder, elbow + RUBS)} if hidden == "friction" else {})
  if hidden == "position gain":
    changed["stiffness"] = (SOFTER * true["stiffness"][0], true["stiffness"][1])
  xml = arm(changed, PAYLOAD if hidden == "payload" else "")
  late = LATE if hidden == "late commands" else 0.0
  force = _spring if hidden == "spring" else None
  folder.mkdir(parents=True, exist_ok=True)
  (folder / "model.xml").write_text(arm(DECLARED))
  for kind in ("sweep", "slow", "steps"):
    wanted = commands(kind, random)
    record(folder / f"train_{kind}.csv", xml, wanted, random, late, force)
    record(folder / f"reference_{kind}.csv", arm(true), commands(kind, random), random, 0.0, None)
  for kind in ("sweep", "steps"):
    record(folder / f"held_{kind}.csv", xml, commands(kind, random), random, late, force)


def identified(folder: Path, *, references: bool) -> dict[str, harness.Value]:
  """Returns what `launch/identify.py` says of a folder."""
  out = folder / ("beside_references" if references else "alone")
  command = [sys.executable, str(ROOT / "launch/identify.py"), "--out", str(out)]
  command += ["--model", str(folder / "model.xml")]
  for option, name in (("--logs", "train"), ("--held", "held"), ("--reference", "reference")):
    if references or name != "reference":
      command += [option, *map(str, sorted(folder.glob(f"{name}_*.csv")))]
  subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
  content = json.loads((out / "report.json").read_text())
  words = []
  for effect in content["effects"]:
    values = [
      f"{name} {value['value']:.3g} ({value['low']:.3g} to {value['high']:.3g}) {value['unit']}"
      for name, value in effect["parameters"].items()
      if None not in (value["value"], value["low"], value["high"])
    ]
    words.append(f"{effect['kind']}@{effect['joint'] or 'all'}: {', '.join(values)}")
  error = content["error"]
  return {
    "verdict": content["verdict"],
    "named": "; ".join(words) or "nothing",
    "held_before_mrad": 1e3 * error["held"]["before"],
    "held_after_mrad": 1e3 * error["held"]["after"],
    "floor_mrad": 1e3 * error["floor"],
  }


def main(settings: Settings) -> None:
  """Makes the logs, identifies and prints the figures."""
  figures = {}
  for number, hidden in enumerate(HIDDEN):
    if hidden not in settings.hidden:
      continue
    folder = settings.folder / hidden.replace(" ", "_")
    make(folder, hidden, settings.seed + number)
    for references in (False, True):
      name = f"{folder.name}{'_beside_references' if references else ''}"
      figures[name] = identified(folder, references=references)
  words = (
    "Hidden: 0.25 kg at 0.18 m on the forearm; commands 24 ms late; 0.2 N m of friction and a "
    "spring of 3 N m/rad about 0.2 rad at the elbow; the shoulder's gain for position at 0.75."
  )
  harness.finish("coupled_arms", figures, settings, seed=settings.seed, words=words)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
