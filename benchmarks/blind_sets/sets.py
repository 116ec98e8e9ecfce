"""Draws a blind set: an apparatus, a machine, what it lacks; writes its logs, returns the truth."""

import copy
import dataclasses
import pathlib
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from . import effects, excitation, recording
from .apparatus import Apparatus, make_apparatus
from .machine import Machine, Reading, build_machine, draw_reading

MIXES = ("single", "pair", "outside", "healthy")
ALL_SHARES = (0.55, 0.15, 0.15, 0.15)
"""Of `MIXES` in the mix `all`."""
PLANT_SHARES = {"pendulum": 0.6, "arm": 0.2, "op3": 0.2}
DECLARED_ERRORS = (0.0, 0.0, 0.0, 0.03, 0.1)
"""Shares by which declared constants are off, drawn once a set."""
DETECTABLE = 2.0
"""A held-out error this many times the healthy machine's can be seen; chosen. Both are of a machine
whose declared constants are right: wrong ones can be calibrated, and hide nothing for good."""


@dataclasses.dataclass(frozen=True)
class Truth:
  """What is in a set; `answer` is its entry of answers.json."""

  mix: str
  answer: dict[str, Any]


@dataclasses.dataclass
class _Draft:
  """A set before its logs are written."""

  seed: tuple[int, int]
  apparatus: Apparatus
  reading: Reading
  declared_error: float
  machine: Machine
  twin: Machine
  """The same machine, were its declared constants right: what can be seen is judged on it."""
  commands: dict[str, np.ndarray]
  runs: dict[str, recording.Recording] = dataclasses.field(default_factory=dict)
  """Recordings made, by log and effects: measuring an effect's size and writing need the same."""

  def run(
    self, log: str, drawn: list[effects.Drawn], *, twin: bool = False, again: bool = False
  ) -> recording.Recording:
    """Returns a recording of the machine, or its twin, with effects; `again` draws other noise."""
    twin = twin and self.declared_error != 0.0
    key = f"{log} {drawn} {twin} {again}"
    if key not in self.runs:
      machine = copy.deepcopy(self.twin if twin else self.machine)
      for effect in drawn:
        effect.apply(machine)
      noise = (*self.seed, list(self.commands).index(log) + len(self.commands) * again)
      self.runs[key] = recording.record(
        self.apparatus, machine, self.reading, commands=self.commands[log], seed=noise
      )
    return self.runs[key]

  def held_errors(self, drawn: list[effects.Drawn], *, twin: bool = False) -> np.ndarray:
    """Returns the declared model's error on the held-out logs, RMSE of each joint [J] rad."""
    squares = [
      declared_error(self.apparatus, self.run(log, drawn, twin=twin)) ** 2
      for log in self.commands
      if log.startswith("held")
    ]
    return np.sqrt(np.mean(squares, axis=0))


def declared_error(apparatus: Apparatus, recorded: recording.Recording) -> np.ndarray:
  """Returns the declared model's error over a whole log, RMSE of each joint [J] rad.

  MuJoCo rolls the declared model out from the first measured position under the log's commands.
  """
  model = apparatus.model
  data = mujoco.MjData(model)
  data.qpos[:] = recorded.position[0]
  full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
  state = np.zeros(mujoco.mj_stateSize(model, full))
  mujoco.mj_getState(model, data, state, full)
  step, first = model.opt.timestep, recorded.stamp[0]
  time = first + np.arange(round((recorded.stamp[-1] - first) / step)) * step
  held = np.searchsorted(recorded.command_time, time, side="right") - 1
  states, _ = rollout.rollout(model, data, state[None], recorded.command[np.maximum(held, 0)][None])
  positions = states[0, :, 1 : 1 + model.nq]
  error = np.zeros(model.nq)
  for joint in range(model.nq):
    # A row of the rollout is the state one step after its time.
    predicted = np.interp(recorded.stamp, time + step, positions[:, joint])
    error[joint] = np.sqrt(np.mean((recorded.position[:, joint] - predicted) ** 2))
  return error


def make_set(
  folder: pathlib.Path,
  *,
  seed: int,
  index: int,
  mix: str = "all",
  plants: tuple[str, ...] | None = None,
  kinds: tuple[str, ...] | None = None,
  reference: bool = False,
) -> Truth:
  """Draws the set `index` of a seed, writes `model.xml` and logs into a folder.

  Args:
    folder: where to; made if missing.
    seed: of the whole collection.
    index: of the set: the same seed and index give the same logs, whatever the count.
    mix: one of `MIXES`, or "all".
    plants: kinds of apparatus to draw from; None is all, in the shares `PLANT_SHARES`.
    kinds: kinds of effect to draw from; None is all that the mix has.
    reference: also write logs of the same machine without the effects.
  """
  rng = np.random.default_rng([seed, index])
  if mix == "all":
    mix = str(rng.choice(MIXES, p=ALL_SHARES))
  names = plants or tuple(PLANT_SHARES)
  shares = np.array([PLANT_SHARES[name] for name in names])
  plant = str(rng.choice(names, p=shares / shares.sum()))
  off = float(rng.choice(DECLARED_ERRORS))
  for _ in range(20):
    drawn_kinds = _draw_kinds(rng, mix, plant, kinds)
    if drawn_kinds is not None:
      break
  else:
    raise ValueError(f"No kind of {kinds} can be drawn for the mix {mix!r} on {plant!r}.")
  if "parameter_error" in drawn_kinds:
    off = 0.0
  draft = _draft(rng, (seed, index), plant, off)
  floor = draft.held_errors([], twin=True)
  drawn = _draw_effects(rng, draft, drawn_kinds, floor)
  errors, healthy = draft.held_errors(drawn), draft.held_errors([])
  folder.mkdir(parents=True, exist_ok=True)
  (folder / "model.xml").write_text(draft.apparatus.xml)
  joints = [draft.apparatus.model.joint(j).name for j in range(draft.apparatus.model.njnt)]
  for name in draft.commands:
    recorded = draft.run(name, drawn)
    recording.write(folder / f"{name}.mcap", joints, recorded, draft.reading)
    if reference and name.startswith("train"):
      path = folder / f"reference_{name[6:]}.mcap"
      recording.write(path, joints, draft.run(name, [], again=True), draft.reading)
  ratio = float(np.max(draft.held_errors(drawn, twin=True) / floor))
  answer = {
    "plant": plant,
    "declared_error": off,
    "effects": [_describe(effect, draft) for effect in drawn],
    "mix": mix,
    "error_ratio": round(ratio, 3),
    "below_floor": bool(drawn) and ratio < DETECTABLE,
    "held_error": float(np.sqrt(np.mean(errors**2))),
    "healthy_held_error": float(np.sqrt(np.mean(healthy**2))),
  }
  return Truth(mix, answer)


def _draw_kinds(
  rng: np.random.Generator, mix: str, plant: str, kinds: tuple[str, ...] | None
) -> tuple[str, ...] | None:
  """Returns the kinds of a set's effects, None where the draw does not fit."""
  if mix == "healthy":
    return ()
  pool = effects.OUTSIDE if mix == "outside" else effects.LIBRARY
  names = [n for n, m in pool.items() if plant in m.plants and (kinds is None or n in kinds)]
  if not names:
    return None
  if mix != "pair":
    return (str(rng.choice(names)),)
  first, second = (str(name) for name in rng.choice(names, 2))
  return (first, second) if effects.may_pair(first, second) else None


def _draft(rng: np.random.Generator, seed: tuple[int, int], plant: str, off: float) -> _Draft:
  apparatus = make_apparatus(plant, rng)
  reading = draw_reading(rng)
  twin = build_machine(apparatus, copy.deepcopy(rng))
  machine = build_machine(apparatus, rng, declared_error=off)
  time = np.arange(round(apparatus.duration / reading.command_period)) * reading.command_period
  count = len(apparatus.center)
  held_center = apparatus.center + rng.uniform(-0.25, 0.25, count) * apparatus.amplitude
  held_amplitude = apparatus.amplitude * rng.uniform(0.55, 0.75)
  commands = {}
  for name, wave in excitation.WAVES.items():
    if name.startswith("held"):
      commands[name] = wave(time, rng, held_center, held_amplitude)
    else:
      commands[name] = wave(time, rng, apparatus.center, apparatus.amplitude)
  return _Draft(seed, apparatus, reading, off, machine, twin, commands)


def _draw_effects(
  rng: np.random.Generator, draft: _Draft, kinds: tuple[str, ...], floor: np.ndarray
) -> list[effects.Drawn]:
  """Draws effects; one that cannot be seen alone is made stronger, as far as its range goes."""
  count = len(draft.apparatus.center)
  joint = int(rng.integers(count))
  drawn = []
  for position, kind in enumerate(kinds):
    if position and rng.random() < 0.5:
      joint = int(rng.integers(count))
    effect = effects.draw_effect(
      kind, rng, joint=joint, center=float(draft.apparatus.center[joint])
    )
    if kind in ("command_delay", "measurement_delay") and count > 1 and rng.random() < 0.5:
      effect.joint = None  # the whole bus is late
    factor = float(rng.uniform(1.3, 1.7))
    for _ in range(4):
      if np.max(draft.held_errors([effect], twin=True) / floor) >= DETECTABLE:
        break
      if not effects.make_stronger(effect, factor):
        break
    drawn.append(effect)
  return drawn


def _describe(effect: effects.Drawn, draft: _Draft) -> dict[str, Any]:
  """Returns an effect as answers.json has it."""
  model = draft.apparatus.model
  joint = None
  if effect.joint is not None:
    joint = model.joint(effect.joint).name
  elif model.njnt == 1 and effect.kind not in ("gravity_tilt", "clock_drift", "supply_sag"):
    joint = None if effect.maker.everywhere else model.joint(0).name
  entry: dict[str, Any] = {"kind": effect.kind, "joint": joint}
  parameters = dict(effect.parameters)
  if effect.kind == "payload" and effect.joint is not None:
    machine = draft.machine
    body = int(model.jnt_bodyid[effect.joint])
    entry["body"] = model.body(body).name
    offset = np.array([parameters.pop(f"off_{axis}") for axis in "xyz"])
    entry["pos"] = [float(v) for v in machine.tree.center[effect.joint] + offset]
  entry |= parameters
  if effect.kind in effects.OUTSIDE:
    entry["in_library"] = False
  return entry
