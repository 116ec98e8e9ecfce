"""The report's pictures of what is left: against time and its causes, and on logs not fitted."""

from collections.abc import Sequence

import numpy as np

from nerf2real.core import palette
from nerf2real.core.pages import charts
from nerf2real.core.pages.blocks import Chart, Grid
from nerf2real.core.pages.charts import Curve
from nerf2real.core.pages.page import Section
from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.suite.effects.kinds import laws
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.signatures import TorqueResidual
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.search.evidence import Scored

Array = np.ndarray

BEFORE, AFTER = palette.VERMILION, palette.BLUE  # declared and extended model
_COGGING, _STRIBECK, _LOAD_FRICTION, _GEAR_LOAD = map(
  laws.over, (laws.cogging, laws.stribeck, laws.load_friction, laws.gear_load)
)
_AT_REST = 0.02  # of the usual highest speed, below which a joint may stick; ours
_WARMER = 1.0  # K by which a joint's temperature must change to be drawn


def unit_of(item: Changed) -> str:
  """Returns the unit of a joint's small errors."""
  return "mrad" if item.likelihood.plant.hinge else "mm"


def residuals(item: Changed) -> Section:
  """Returns residuals, before and after, against what they may depend on."""
  joint, unit = item.likelihood, unit_of(item)
  hypotheses = ((item.declared, "declared", BEFORE), (item.extended, "extended", AFTER))
  figures: list[Chart | None] = []
  left = [joint.courses(h.terms, h.fit.x) for h, _, _ in hypotheses]
  for index, log in enumerate(joint.plant.logs):
    curves = [
      Curve(name, color, log.time[log.valid], 1e3 * courses[index][log.valid])
      for (_, name, color), courses in zip(hypotheses, left, strict=True)
    ]
    title = f"{log.name}: residual against time"
    figures.append(charts.lines(title, "time [s]", f"position residual [{unit}]", curves))
  for name in ("position", "velocity", "load", "temperature"):
    figures.append(_against(item, hypotheses, name))
  note = (
    "" if figures[-1] is not None else " These logs hold no temperatures of this joint that change."
  )
  return Section(
    f"Residual of {item.joint}, before and after",
    "Against time: measured minus simulated position. Against the others: the torque that the"
    " model lacks (what the measured motion demands by inverse dynamics, less what actuator and"
    " friction give), medians and quartiles; a flat line at zero is a model that lacks nothing, a"
    " step at zero velocity is dry friction, a slope over velocity is damping. Against temperature"
    f" it counts along the actuator's: below zero is an actuator that weakens.{note}",
    [Grid([f for f in figures if f is not None], 2)],
  )


def _against(item: Changed, hypotheses, name: str) -> Chart | None:
  plant = item.likelihood.plant
  curves = []
  for hypothesis, label, color in hypotheses:
    x, y = [], []
    for index, log in enumerate(plant.logs):
      r, missing = _missing_torque(plant, hypothesis, index)
      if name == "temperature":
        if log.temperature is None:
          return None
        x.append(log.temperature[signatures.EDGES : -signatures.EDGES])
        missing = missing * np.sign(r.torque)
      else:
        x.append({"position": r.position, "velocity": r.velocity, "load": r.torque}[name])
      y.append(missing)
    if name == "temperature" and np.ptp(np.concatenate(x)) < _WARMER:
      return None
    curves.append(Curve(label, color, np.concatenate(x), np.concatenate(y)))
  hinge = plant.hinge
  torque = "N m" if hinge else "N"
  length = "rad" if hinge else "m"
  unit = {"position": length, "velocity": f"{length}/s", "load": torque, "temperature": "C"}[name]
  what = "torque" if hinge else "force"
  along = " along the actuator's" if name == "temperature" else ""
  return charts.binned(
    f"missing {what}{along} against {name}", f"{name} [{unit}]", f"{what} [{torque}]", curves
  )


def held_out(
  found: Identified,
  held: Sequence[Log],
  effects: Sequence[Effect],
  items: Sequence[Changed],
  window_s: float,
) -> Section:
  """Returns measured and simulated positions, and their residuals, of logs that were not fitted."""
  figures = []
  for log in held:
    measured, time = log.states.position, log.states.stamp
    assert measured is not None
    before = evaluation.simulate(found.model, log, window_s=window_s)
    after = evaluation.simulate(found.model, log, effects, clocks=found.clocks, window_s=window_s)
    for item in items:
      joint, unit = item.joint, unit_of(item)
      column = log.states.column(joint)
      pair = (
        ("declared", BEFORE, before[:, column]),
        ("extended", AFTER, after[:, column]),
      )
      curves = [Curve(n, c, time, y) for n, c, y in pair]
      curves = [Curve("measured", palette.INK, time, measured[:, column]), *curves]
      length = "rad" if unit == "mrad" else "m"
      figures.append(
        charts.lines(f"{log.name}: {joint}", "time [s]", f"position [{length}]", curves)
      )
      errors = [Curve(n, c, time, 1e3 * (measured[:, column] - y)) for n, c, y in pair]
      title = f"{log.name}: {joint}, residual"
      figures.append(charts.lines(title, "time [s]", f"residual [{unit}]", errors))
  return Section(
    "Logs that were not fitted",
    "Measured and simulated positions; the commands alone drive the simulation.",
    [Grid(figures, 2)],
  )


def _missing_torque(plant: JointModel, item: Scored, index: int) -> tuple[TorqueResidual, Array]:
  """Returns a log's regressors and the missing torque [N] at the same samples.

  Args:
    plant: the joint.
    item: a hypothesis.
    index: of the log.
  """
  hypothesis = compose(plant, item.terms, item.fit.x)
  r = signatures.torque_residual(plant, hypothesis, index)
  value = dict(zip(INDEX, hypothesis.p, strict=True))
  needed = -r.residual + value["drag"] * np.abs(r.velocity) * r.velocity
  needed -= _COGGING(r.position, value["amplitude"], value["periods"], value["phase"])
  limit = _friction(value, r, needed)
  moving = np.abs(r.velocity) > _AT_REST * np.quantile(np.abs(r.velocity), 0.98)
  sliding = needed + limit * np.sign(r.velocity)
  sticking = np.sign(needed) * np.maximum(np.abs(needed) - limit, 0.0)
  return r, np.where(moving, sliding, sticking)


def _friction(value: dict[str, float], r: TorqueResidual, needed: Array) -> Array:
  """Returns the limit of dry friction [N]."""
  motor = r.torque - value["damping"] * r.velocity
  load = _GEAR_LOAD(value["load_kind"], r.torque, motor, motor + needed)
  names = ("load_coefficient", "load_square", "load_at_rest", "load_velocity")
  rubbing = _LOAD_FRICTION(load, r.velocity, *(value[name] for name in names))
  falling = _STRIBECK(r.velocity, value["breakaway"], value["stribeck_velocity"])
  return value["friction"] + falling + rubbing
