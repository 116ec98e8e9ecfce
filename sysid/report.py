"""report.html: what was found, how sure, and the pictures to judge it by."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from scenes import report_parts as parts
from suite.effects import Effect
from sysid import decision, evaluation, signatures
from sysid.fitting import Fit
from sysid.identification import Found, Identified
from sysid.logs import Log

Array = np.ndarray

_BEFORE, _AFTER, _INK = "#D55E00", "#0072B2", "#1d2330"
_POINTS = 1500  # a curve is thinned to this many points: a page of a few MB
_FEW = 1e-9


def page(
  found: Identified,
  content: dict[str, Any],
  held: Sequence[Log],
  effects: Sequence[Effect],
  window_s: float,
) -> str:
  """Returns the page.

  Args:
    found: what was identified.
    content: what report.json holds.
    held: logs that were not fitted.
    effects: calibration and effects of the extended model.
    window_s: window of restarts.
  """
  item = found.found[0]
  for candidate in found.found:
    if candidate.finding.named:
      item = candidate
      break
  sections = [
    _verdict(content),
    _errors(content),
    _residuals(item),
    _ladder(found),
    _where(content),
  ]
  if held:
    sections.append(_held(found, held, effects, item.screened.joint, window_s))
  sections += [_joints(found), _next(content), _audit(content)]
  names = ", ".join(e["kind"] for e in content["effects"]) or "no effect"
  return parts.page(
    "What the model lacks",
    f"Verdict: {content['verdict']} ({names}). Errors are measured minus simulated positions.",
    sections,
    with_plots=True,
  )


def _verdict(content: dict[str, Any]) -> str:
  rows = []
  for effect in content["effects"]:
    for name, value in effect["parameters"].items():
      if isinstance(value.get("value"), list):
        continue
      interval = "" if value["low"] is None else f"{value['low']:.4g} to {value['high']:.4g}"
      where = effect["joint"] or "all"
      rows.append([effect["kind"], where, name, _number(value["value"]), interval, value["unit"]])
  text = {
    "none": "The declared model explains the logs as well as any candidate: nothing is named.",
    "effects": "These effects explain what the declared model leaves; intervals are 95 %.",
    "unexplained": "There is something, and no candidate explains it. A learned force lowers the "
    "error meanwhile; the best candidates are in the ladder below.",
  }[content["verdict"]]
  body = parts.table(["effect", "joint", "parameter", "value", "95 %", "unit"], rows)
  confounded = [a for a in content["alternatives"] if a.get("confounded")]
  notes = [f"As good an explanation: {a['kind']} at {a['joint']}." for a in confounded]
  return parts.section("Verdict", text, parts.warnings(notes), body if rows else "")


def _number(value: Any) -> str:
  return "infinite" if value is None else f"{value:.4g}"


def _errors(content: dict[str, Any]) -> str:
  rows = []
  for name in ("train", "held"):
    error = content["error"][name]
    if error:
      ratio = error["before"] / max(error["after"], _FEW)
      rows.append([name, 1e3 * error["before"], 1e3 * error["after"], f"{ratio:.1f} times"])
  rows.append(["noise of the readings", "", 1e3 * content["error"]["floor"], ""])
  window = content["window_s"]
  how = "whole logs" if window is None else f"windows of {window} s from the measured state"
  text = f"RMSE of position in thousandths (mrad or mm), simulated by MuJoCo over {how}."
  return parts.section(
    "Error before and after", text, parts.table(["logs", "declared", "extended", "lower by"], rows)
  )


def _residuals(item: Found) -> str:
  """Returns residual torque and position, before and after, against what they may depend on."""
  problem = item.screened.problem
  before = Fit((), np.zeros(0), 0.0, 1.0, 0)
  after = item.finding.chosen.fit
  figures = []
  for log, title in ((i, problem.plant.logs[i].name) for i in range(len(problem.plant.logs))):
    figure = go.Figure()
    for fit, name, color in ((before, "declared", _BEFORE), (after, "extended", _AFTER)):
      output = problem.simulate(fit.terms, fit.x)[0][log]
      measured = problem.plant.logs[log]
      keep = _thin(len(measured.time))
      error = 1e3 * (measured.position - output.position)
      figure.add_trace(
        go.Scattergl(x=measured.time[keep], y=error[keep], name=name, line={"color": color})
      )
    figures.append(_figure(figure, title, "time [s]", "position residual [mrad]"))
  figures += [_against(item, name) for name in ("position", "velocity", "load", "temperature")]
  return parts.section(
    f"Residual of {item.screened.joint}, before and after",
    "Position residuals against time; residual torque (measured motion through inverse dynamics) "
    "in bins of position, velocity, load and temperature, with the spread within a bin.",
    parts.grid([f for f in figures if f], 2),
  )


def _against(item: Found, name: str) -> str:
  problem = item.screened.problem
  figure = go.Figure()
  hypotheses = (
    (Fit((), np.zeros(0), 0.0, 1.0, 0), "declared", _BEFORE),
    (item.finding.chosen.fit, "extended", _AFTER),
  )
  for fit, label, color in hypotheses:
    x, y = [], []
    for index, log in enumerate(problem.plant.logs):
      r = signatures.torque_residual(problem, fit, index)
      inner = slice(signatures.EDGES, -signatures.EDGES)
      if name == "temperature":
        if log.temperature is None:
          return ""
        x.append(log.temperature[inner])
      else:
        x.append({"position": r.position, "velocity": r.velocity, "load": r.torque}[name])
      y.append(-r.residual)
    centre, mean, spread = _binned(np.concatenate(x), np.concatenate(y))
    figure.add_trace(
      go.Scatter(
        x=centre,
        y=mean,
        name=label,
        mode="lines+markers",
        line={"color": color},
        error_y={"type": "data", "array": spread, "thickness": 1},
      )
    )
  unit = {"position": "rad", "velocity": "rad/s", "load": "N m", "temperature": "C"}[name]
  return _figure(figure, f"missing torque against {name}", f"{name} [{unit}]", "torque [N m]")


def _binned(x: Array, y: Array, count: int = 24) -> tuple[Array, Array, Array]:
  edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))
  if len(edges) < 3:
    return np.array([x.mean()]), np.array([y.mean()]), np.array([y.std()])
  which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
  rows = [(x[which == k].mean(), np.median(y[which == k]), y[which == k].std())
          for k in range(len(edges) - 1) if np.any(which == k)]  # fmt: skip
  table = np.array(rows)
  return table[:, 0], table[:, 1], table[:, 2]


def _ladder(found: Identified) -> str:
  blocks = []
  for item in found.found:
    ladder = item.ladder
    rows = [
      ["declared model", ladder.declared.score, 0.0, ""],
      ["constants calibrated", ladder.null.score, ladder.declared.score - ladder.null.score, ""],
    ]
    entries = sorted(
      decision.unique([*ladder.singles, *ladder.pairs]), key=lambda e: e.score
    )[:12]  # fmt: skip
    for entry in entries:
      mark = "chosen" if decision.names(entry) == decision.names(item.finding.chosen) else ""
      if any(decision.names(entry) == decision.names(c) for c in item.finding.confounded):
        mark = "confounded"
      label = " + ".join(sorted(decision.names(entry)))
      rows.append([label, entry.score, ladder.declared.score - entry.score, mark])
    blocks.append(f"<h3>{html.escape(item.screened.joint)}</h3>")
    blocks.append(parts.table(["hypothesis", "score [nats]", "gain [nats]", ""], rows))
    blocks.append(_bars(rows))
  return parts.section(
    "Evidence ladder",
    "Score: mean over logs of the logarithm of the error in noise units (0.69 nats halve it). "
    "A name needs a gain over the calibrated constants and a margin over the runner-up.",
    *blocks,
  )


def _bars(rows: Sequence[Sequence[Any]]) -> str:
  figure = go.Figure(
    go.Bar(
      x=[row[2] for row in rows][::-1],
      y=[row[0] for row in rows][::-1],
      orientation="h",
      marker_color=_AFTER,
    )
  )
  return _figure(figure, "gain over the declared model", "nats", "", height=60 + 24 * len(rows))


def _where(content: dict[str, Any]) -> str:
  at = content["residual_at"]
  rows = [
    [name, f"{at[name]['low']:.3g} to {at[name]['high']:.3g}", at[name]["share_of_square"]]
    for name in ("position", "velocity", "time")
  ]
  text = f"What is left sits at {at['joint']}, most in {at['log']}; a fifth of the samples holds:"
  return parts.section(
    "Where the rest sits", text, parts.table(["over", "range", "share of the square"], rows)
  )


def _held(
  found: Identified, held: Sequence[Log], effects: Sequence[Effect], joint: str, window_s: float
) -> str:
  figures = []
  for log in held:
    assert log.states.position is not None
    column = log.states.column(joint)
    before = evaluation.simulate(found.model, log, window_s=window_s)[:, column]
    after = evaluation.simulate(found.model, log, effects, clocks=found.clocks, window_s=window_s)[
      :, column
    ]
    keep = _thin(len(log.states.stamp))
    figure = go.Figure()
    for y, name, color in (
      (log.states.position[:, column], "measured", _INK),
      (before, "declared", _BEFORE),
      (after, "extended", _AFTER),
    ):
      figure.add_trace(
        go.Scattergl(x=log.states.stamp[keep], y=y[keep], name=name, line={"color": color})
      )
    figures.append(_figure(figure, log.name, "time [s]", f"{joint} [rad]"))
  return parts.section(
    "Logs that were not fitted",
    "Measured and simulated positions; the commands alone drive the simulation.",
    parts.grid(figures, 2),
  )


def _joints(found: Identified) -> str:
  rows = [
    [s.joint, s.declared.score, s.null.score, s.excess,
     ", ".join(f"{n} {v:+.3f}" for n, v in s.null.fit.values("calibration").items()
               if n not in ("skew", "latency"))]
    for s in found.screened
  ]  # fmt: skip
  return parts.section(
    "Joints",
    "Scores of the declared and the calibrated model, what the latter leaves above the noise, and "
    "the relative errors of the declared constants.",
    parts.table(["joint", "declared", "calibrated", "left [nats]", "constants"], rows),
  )


def _next(content: dict[str, Any]) -> str:
  proposal = content["next_excitation"]
  rows = [[k, str(v)] for k, v in proposal.items() if k != "all_designs"]
  designs = proposal.get("all_designs", {})
  return parts.section(
    "What to record next",
    "The motion under which the remaining hypotheses differ most, in units of the sensor's noise.",
    parts.table(["", ""], rows),
    parts.table(["design", "separation"], [[k, v] for k, v in designs.items()]),
  )


def _audit(content: dict[str, Any]) -> str:
  audits = content["audit"]
  warnings = [w for a in audits for w in a["warnings"]]
  keys = [k for k in audits[0] if k not in ("log", "warnings")]
  rows = [[a["log"], *[a[k] for k in keys]] for a in audits]
  return parts.section("The logs", "", parts.warnings(warnings), parts.table(["log", *keys], rows))


def _thin(count: int) -> slice:
  return slice(None, None, max(1, count // _POINTS))


def _figure(figure: go.Figure, title: str, x: str, y: str, *, height: int = 300) -> str:
  figure.update_layout(
    title={"text": title, "font": {"size": 14}}, template="plotly_white", height=height,
    margin={"l": 60, "r": 16, "t": 40, "b": 44}, xaxis_title=x, yaxis_title=y,
    legend={"orientation": "h", "y": 1.12, "x": 1, "xanchor": "right"}, font={"size": 12},
  )  # fmt: skip
  return figure.to_html(full_html=False, include_plotlyjs=False, config={"responsive": True})
