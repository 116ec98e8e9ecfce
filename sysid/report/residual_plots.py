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
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.report import balance
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joints.changes import Changed

BEFORE, AFTER = palette.VERMILION, palette.BLUE  # declared and extended model
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
      r, missing = balance.missing_torque(plant, hypothesis, index)
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
