"""report.html: what was found, how sure, and the pictures to judge it by."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core.pages import charts
from nerf2real.core.pages.blocks import Block, Heading, Table, Text, Warnings
from nerf2real.core.pages.charts import Bars, Interval
from nerf2real.core.pages.page import Origin, Page, Section
from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.report import meanings, residual_plots
from nerf2real.sysid.report.residual_plots import AFTER, BEFORE
from nerf2real.sysid.selection import decision, race
from nerf2real.sysid.selection.findings import Identified

Array = np.ndarray

_FEW = 1e-9
_SHOWN = 3  # joints whose held-out overlays are shown
_LADDER = 12  # hypotheses a joint
_VERDICTS = {
  "none": "The declared model explains the logs as well as any candidate: nothing is named.",
  "effects": "These effects explain what the declared model leaves.",
  "partly": "These effects are certain and explain most of what the declared model leaves; more"
  " remains than reference logs leave, and no name for it is clear. What remains is said below.",
  "unexplained": "There is something that no candidate explains well enough to be named. Where it"
  " sits is said below; a learned force lowers the error meanwhile where that is possible, and the"
  " ladder shows the candidates that came nearest.",
}


def page(
  found: Identified,
  content: dict[str, Any],
  details: dict[str, Any],
  held: Sequence[Log],
  effects: Sequence[Effect],
  window_s: float,
) -> Page:
  """Returns the page.

  Args:
    found: what was identified.
    content: what report.json holds.
    details: what details.json holds.
    held: logs that were not fitted.
    effects: calibration and effects of the extended model.
    window_s: window of restarts.
  """
  items = [f for f in found.found if f.finding.named] or found.found[:1]
  sections = [
    _verdict(content),
    _errors(found, content),
    *[residual_plots.residuals(item) for item in items[:_SHOWN]],
    _ladder(found),
    _where(content, details, residual_plots.unit_of(found.least_explained)),
  ]
  if held:
    sections.append(residual_plots.held_out(found, held, effects, items[:_SHOWN], window_s))
  sections += [_joints(found), _next(content), _audit(details), meanings.section()]
  names = _summary(content["effects"])
  return Page(
    "What the model lacks",
    f"Verdict: {content['verdict']}{': ' + names if names else ''}. Model:"
    f" {details['model'].rsplit('/', 1)[-1]}. Residuals are measured minus simulated.",
    sections,
    origin=Origin.of_process(),
  )


def _summary(effects: Sequence[dict[str, Any]]) -> str:
  """Returns kinds with where they are; many joints are counted."""
  where: dict[str, list[str]] = {}
  for effect in effects:
    where.setdefault(effect["kind"], []).append(_place(effect))
  return ", ".join(
    f"{kind} ({', '.join(places) if len(places) <= _SHOWN else f'{len(places)} joints'})"
    for kind, places in where.items()
  )


def _place(effect: dict[str, Any]) -> str:
  places = (effect["joint"], *(effect.get(noun) for noun in ("body", "geom", "sensor")))
  return next((place for place in places if place), "all")


def _verdict(content: dict[str, Any]) -> Section:
  rows, bounds = _parameters(content["effects"])
  notes = [
    f"As good an explanation of {a['joint']}: {a['kind']}."
    for a in content["alternatives"]
    if a.get("confounded")
  ]
  # Of what is unexplained, the nearest hypothesis is among the alternatives, with intervals.
  listed = [a for a in content["alternatives"] if "kinds" not in a]
  nearest, _ = _parameters([a for a in listed if "sensor" not in a])
  alike, _ = _parameters([a for a in listed if "sensor" in a])
  blocks: list[Block] = [Warnings([*notes, *content["notes"]])]
  if rows:
    blocks.append(Table(_HEADER, rows))
    chart = charts.intervals("95 % intervals", bounds)
    blocks += [chart] if chart is not None else []
  if nearest:
    blocks += [Heading("In the extended model, but not claimed"), Table(_HEADER, nearest)]
  usual, _ = _parameters(content["in_reference"])
  if usual:
    blocks += [Heading("In the reference, too: the model lacks them, nothing changed")]
    blocks += [Table(_HEADER, usual)]
  if alike:
    blocks += [Heading("One of these, the sensors cannot tell which"), Table(_HEADER, alike)]
  return Section(f"Verdict: {content['verdict']}", _VERDICTS[content["verdict"]], blocks)


_FOLLOWED = (
  "The simulated state follows the readings here: courses with play do not repeat. Errors are of"
  " what a model predicts from each reading on, so all hypotheses are nearer to the noise."
)
_HEADER = ["effect", "where", "parameter", "value", "95 % interval", "unit", "gain [nats]"]


def _parameters(effects: Sequence[dict[str, Any]]) -> tuple[list[list[Any]], list[Interval]]:
  """Returns a table's rows, and the intervals that are known."""
  rows: list[list[Any]] = []
  bounds = []
  for effect in effects:
    where = _place(effect)
    evidence = effect["evidence"]
    gain = evidence.get("gain_over_constants_nats", evidence.get("gain_nats", ""))
    for name, value in effect["parameters"].items():
      choice = value["low"] is None and not kind_of(effect["kind"]).parameter(name).fitted
      if choice or isinstance(value["value"], list):
        continue
      known = None not in (value["value"], value["low"], value["high"])
      interval = f"{value['low']:.4g} to {value['high']:.4g}" if known else ""
      number = _number(value["value"])
      rows.append([effect["kind"], where, name, number, interval, value["unit"], gain])
      if known and value["high"] > value["low"]:
        label = f"{effect['kind']} {name} ({where})"
        bounds.append(Interval(label, value["value"], value["low"], value["high"]))
    if not effect["parameters"]:
      rows.append([effect["kind"], where, "a table over position and speed", "", "", "", ""])
  return rows, bounds


def _number(value: Any) -> str:
  return "infinite" if value is None else f"{value:.4g}"


def _errors(found: Identified, content: dict[str, Any]) -> Section:
  names = (("train", "fitted logs"), ("held", "logs that were not fitted"))
  errors = [(label, content["error"][name]) for name, label in names]
  rows = []
  for label, error in errors:
    if error:
      ratio = error["before"] / max(error["after"], _FEW)
      rows.append([label, 1e3 * error["before"], 1e3 * error["after"], f"{ratio:.1f} times"])
  rows.append(["noise of the readings", "", 1e3 * content["error"]["floor"], ""])
  window = content["window_s"]
  how = "whole logs" if window is None else f"windows of {window} s from the measured state"
  units = sorted({residual_plots.unit_of(f) for f in found.found})
  text = f"RMSE of position in {' or '.join(units)}, simulated by MuJoCo over {how}."
  worse = [label for label, error in errors if error and evaluation.is_worse(error)]
  if worse:
    text += f" On {' and '.join(worse)} the extended model is worse: do not use it."
  blocks: list[Block] = [Table(["logs", "declared", "extended", "lower by"], rows)]
  if len(found.screened) > 1:
    blocks.append(_by_joint(found))
  return Section("Error before and after", text, blocks)


def _by_joint(found: Identified) -> Block:
  chosen = {f.screened.joint: f.finding.chosen for f in found.found}
  before, after, names = [], [], []
  for s in found.screened:
    noise = 1e3 * s.problem.position_noise
    names.append(s.joint)
    before.append(noise * float(np.sqrt(np.mean(s.declared.levels[:, 0] ** 2))))
    levels = race.levels(s.problem, chosen.get(s.joint, s.null).fit)
    after.append(noise * float(np.sqrt(np.mean(levels[:, 0] ** 2))))
  series = [Bars("declared", BEFORE, before), Bars("extended", AFTER, after)]
  return charts.bars(
    "fitted logs by joint, the others prescribed", "RMS of position [mrad or mm]", series, names
  )


def _ladder(found: Identified) -> Section:
  blocks: list[Block] = []
  brief = []
  for rank, item in enumerate(found.found):
    ladder = item.ladder
    if rank >= _SHOWN:
      chosen = item.finding.chosen
      gain = ladder.null.score - chosen.score
      others = [e.score for e in item.finding.alternatives]
      behind = round(min(others) - chosen.score, 3) if others else ""
      named = " + ".join(sorted(decision.names(chosen))) or "constants calibrated"
      brief.append([item.screened.joint, named, gain, behind])
      continue
    rows: list[list[Any]] = [
      ["declared model", ladder.declared.score, 0.0, ""],
      ["constants calibrated", ladder.null.score, ladder.declared.score - ladder.null.score, ""],
    ]
    entries = decision.unique(sorted([*ladder.singles, *ladder.pairs], key=lambda e: e.score))
    own = decision.names(item.finding.chosen)
    if not own:
      rows[1][3] = "chosen"
    else:
      kept = [e for e in entries[:_LADDER] if decision.names(e) != own]
      entries = sorted([*kept, item.finding.chosen], key=lambda e: e.score)
    confounded = [decision.names(c) for c in item.finding.confounded]
    for entry in entries[:_LADDER]:
      names = decision.names(entry)
      mark = "chosen" if names == own else ("as good" if names in confounded else "")
      label = " + ".join(sorted(names))
      rows.append([label, entry.score, ladder.declared.score - entry.score, mark])
    blocks.append(Heading(item.screened.joint))
    if ladder.problem.plant.follows:
      blocks.append(Text(_FOLLOWED))
    blocks.append(Table(["hypothesis", "score [nats]", "gain [nats]", ""], rows))
    series = [Bars("gain", AFTER, [row[2] for row in rows])]
    blocks.append(charts.bars("gain over the declared model", "nats", series, [r[0] for r in rows]))
  if brief:
    blocks.append(Heading("The other joints that were looked at closely"))
    header = ["joint", "chosen", "gain over the constants [nats]", "runner-up behind [nats]"]
    blocks.append(Table(header, brief))
  return Section(
    "Evidence ladder",
    "Score: the logarithm of the error in units of the noise, averaged over the logs; 0.69 nats"
    " halve the error. A name needs a gain over the calibrated constants and a margin over the"
    " runner-up.",
    blocks,
  )


def _where(content: dict[str, Any], details: dict[str, Any], unit: str) -> Section:
  at = content["residual_at"]
  quantities = {
    "position": "rad" if unit == "mrad" else "m",
    "velocity": "rad/s" if unit == "mrad" else "m/s",
    "time": "s",
  }
  rows = [
    [
      f"{name} [{quantity}]",
      f"{at[name]['low']:.3g} to {at[name]['high']:.3g}",
      f"{100 * at[name]['share_of_square']:.0f} %",
    ]
    for name, quantity in quantities.items()
  ]
  tests = details["tests"]
  checks = [
    [name, tests["declared"][name]["p"], tests["extended"][name]["p"]] for name in tests["declared"]
  ]
  text = (
    f"The extended model leaves {1e3 * at['rms']:.3g} {unit} RMS at {at['joint']}, most in"
    f" {at['log']}. The fifth of the samples that holds most of its square:"
  )
  return Section(
    "Where the rest sits",
    text,
    [
      Table(["over", "range", "share of the square"], rows),
      Heading("Does it go with anything?"),
      Text(
        "Chance of as large a correlation of the whitened residual, by resampling blocks of a"
        " second; small numbers say yes."
      ),
      Table(["with", "declared", "extended"], checks),
    ],
  )


def _joints(found: Identified) -> Section:
  rows = [
    [
      s.joint,
      s.declared.score,
      s.null.score,
      s.excess,
      ", ".join(
        f"{n} {100 * v:+.1f} %"
        for n, v in s.null.fit.values("calibration").items()
        if n not in ("skew", "latency")
      ),
      1e3 * found.clocks[s.joint].skew,
      1e3 * found.clocks[s.joint].latency,
    ]
    for s in found.screened
  ]
  header = ["joint", "declared", "calibrated", "left [nats]", "constants off by"]
  return Section(
    "Joints",
    "Scores of the declared and the calibrated model, what the latter leaves above the noise, the"
    " relative errors of the declared constants, and the latencies of readings and commands that"
    " are taken for the machine's own.",
    [Table([*header, "reading late [ms]", "command late [ms]"], rows)],
  )


def _next(content: dict[str, Any]) -> Section:
  proposal = content["next_excitation"]
  rows = [
    [k.replace("_", " "), "; ".join(" + ".join(x) for x in v) if isinstance(v, list) else str(v)]
    for k, v in proposal.items()
    if k != "all_designs"
  ]
  designs = proposal.get("all_designs", {})
  blocks: list[Block] = [Table(["", ""], rows)]
  if designs:
    blocks.append(Heading("All motions that were tried"))
    blocks.append(Table(["motion", "separation"], list(designs.items())))
  return Section(
    "What to record next",
    "The motion under which the remaining hypotheses differ most, in units of the sensor's noise.",
    blocks,
  )


def _audit(details: dict[str, Any]) -> Section:
  audits = details["audit"]
  warnings = [w for a in audits for w in a["warnings"]]
  keys = [k for k in audits[0] if k not in ("log", "warnings")]
  rows = [[k.replace("_", " "), *[a[k] for a in audits]] for k in keys]
  header = ["", *[a["log"] for a in audits]]
  return Section("The logs", "", [Warnings(warnings), Table(header, rows)])
