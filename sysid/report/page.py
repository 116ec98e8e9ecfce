"""report.html: what was found, how sure, and the pictures to judge it by."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core.pages import charts
from nerf2real.core.pages.blocks import Block, Heading, Notes, Table, Text, Warnings
from nerf2real.core.pages.charts import Bars, Interval
from nerf2real.core.pages.page import Origin, Page, Section
from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.design.identifiability import Identifiability
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.fit.likelihood import rms_of
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.report import capability, meanings, residual_plots, summary
from nerf2real.sysid.report.alike import place, together
from nerf2real.sysid.report.residual_plots import AFTER, BEFORE
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.search.evidence import clear

Array = np.ndarray

_FEW = 1e-9
_SHOWN = 3  # joints whose held-out overlays are shown
_LADDER = 12  # hypotheses a joint
_HEADLINES = {
  "none": "Nothing that these logs show",
  "effects": "It lacks",
  "partly": "It lacks this and more",
  "unexplained": "It lacks something that has no clear name",
}
_VERDICTS = {
  "none": "No candidate explains these logs clearly better than the declared model with its"
  " constants fitted within their tolerances: nothing is named.",
  "effects": "These effects explain what the declared model leaves.",
  "partly": "These effects are certain, and each explains more than it leaves; more"
  " remains than the machine leaves anyway, and no name for it is clear. What remains is said"
  " below.",
  "unexplained": "There is something that no candidate explains well enough to be named. Where it"
  " sits is said below; a force of any form over position and velocity lowers the error meanwhile"
  " where that is possible, and the evidence shows the candidates that came nearest.",
}


def page(
  found: Identified,
  content: dict[str, Any],
  details: dict[str, Any],
  *,
  held: Sequence[Log],
  effects: Sequence[Effect],
  shown: Sequence[Identifiability],
  window_s: float,
  referred: bool,
) -> Page:
  """Returns the page.

  Args:
    found: what was identified.
    content: what report.json holds.
    details: what details.json holds.
    held: logs that were not fitted.
    effects: calibration and effects of the extended model.
    shown: what the logs can show, by joint.
    window_s: window of restarts.
    referred: whether there were reference logs.
  """
  items = found.found
  subject = found.least_explained.subject
  content = {**content, **{k: together(content[k]) for k in ("effects", "in_reference")}}
  sections = [
    summary.section(
      content,
      asked=subject.thresholds,
      unit=residual_plots.unit_of(found.least_explained),
      shown=capability.sentence(shown),
      referred=referred,
    ),
    _verdict(content, [note for note in content["notes"] if note != capability.sentence(shown)]),
    _errors(found, content),
    *[residual_plots.residuals(item) for item in items[:_SHOWN]],
    _ladder(found),
    _where(content, details, residual_plots.unit_of(found.least_explained)),
  ]
  if held:
    sections.append(residual_plots.held_out(found, held, effects, items[:_SHOWN], window_s))
  sections += [_joints(found), _next(content), capability.section(shown)]
  sections += [_audit(details), meanings.section()]
  names = _summary(content["effects"])
  return Page(
    "What the model lacks",
    f"{_headline(content, referred)}{': ' + names if names else ''}. Model:"
    f" {details['model'].rsplit('/', 1)[-1]}. Residuals are measured minus simulated.",
    sections,
    origin=Origin.of_process(),
  )


def _headline(content: dict[str, Any], referred: bool) -> str:
  verdict = content["verdict"]
  unchanged = verdict == "none" and referred
  if verdict == "none" and not referred and summary.is_far(content["error"]):
    return "Nothing that has a name, yet the model does not fit"
  return "Nothing that the reference does not show, too" if unchanged else _HEADLINES[verdict]


def _summary(effects: Sequence[dict[str, Any]]) -> str:
  """Returns kinds with where they are; many joints are counted."""
  where: dict[str, list[str]] = {}
  for effect in effects:
    where.setdefault(effect["kind"], []).append(place(effect))
  return ", ".join(
    f"{kind} ({', '.join(places) if len(places) <= _SHOWN else f'{len(places)} joints'})"
    for kind, places in where.items()
  )


def _verdict(content: dict[str, Any], said: Sequence[str]) -> Section:
  rows, bounds = _parameters(content["effects"])
  notes = [
    f"As good an explanation of {where}: {summary.either(kinds, ())}."
    for where, kinds in summary.alike_by_place(content["alternatives"]).items()
  ]
  # Of what is unexplained, the nearest hypothesis is among the alternatives, with intervals.
  listed = [a for a in content["alternatives"] if "kinds" not in a]
  nearest, _ = _parameters([a for a in listed if "sensor" not in a])
  alike, _ = _parameters([a for a in listed if "sensor" in a])
  blocks: list[Block] = [Warnings(notes), Notes(said)]
  if rows:
    blocks.append(Table(_HEADER, rows))
    chart = charts.intervals("95 % intervals", bounds)
    blocks += [chart] if chart is not None else []
    blocks.append(Notes(_choices(content["effects"])))
  if nearest:
    blocks += [Heading("In the extended model, but not claimed"), Table(_HEADER, nearest)]
  usual, _ = _parameters(content["in_reference"])
  if usual:
    blocks += [Heading("In the reference, too: the model lacks them, nothing changed")]
    blocks += [Table(_HEADER[:-1], [row[:-1] for row in usual])]
  if alike:
    blocks += [Heading("One of these, the sensors cannot tell which"), Table(_HEADER, alike)]
  return Section(f"Verdict: {content['verdict']}", _VERDICTS[content["verdict"]], blocks)


_HEADER = ["effect", "where", "parameter", "value", "95 % interval", "unit", "gain [nats]"]


def _parameters(effects: Sequence[dict[str, Any]]) -> tuple[list[list[Any]], list[Interval]]:
  """Returns a table's rows, and the intervals that are known."""
  rows: list[list[Any]] = []
  bounds = []
  for effect in effects:
    where = place(effect)
    evidence = effect["evidence"]
    gain = evidence.get("held_out_gain_nats", evidence.get("gain_nats", ""))
    for name, value in effect["parameters"].items():
      if _is_choice(effect, name):
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


def _is_choice(effect: dict[str, Any], name: str) -> bool:
  """Tells whether a parameter chooses between models, so that its row would be no figure."""
  unsure = effect["parameters"][name]["low"] is None
  return unsure and not kind_of(effect["kind"]).parameter(name).fitted


def _choices(effects: Sequence[dict[str, Any]]) -> list[str]:
  """Returns which of its models an effect has, a sentence each that is on."""
  said = []
  for effect in effects:
    chosen = [n for n, v in effect["parameters"].items() if v["value"] == 1.0]
    for name in (n for n in chosen if _is_choice(effect, n)):
      meaning = kind_of(effect["kind"]).parameter(name).doc  # "1 if it is so, else 0"
      so = meaning.removeprefix("1 if ").rpartition(", ")[0] or meaning
      said.append(f"{effect['kind']} ({place(effect)}), {name}: {so}.")
  return said


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
  if len(found.joints) > 1:
    blocks.append(_by_joint(found))
  return Section("Error before and after", text, blocks)


def _by_joint(found: Identified) -> Block:
  before, after = (
    [1e3 * rms_of(j.likelihood.courses(h.terms, h.fit.x)) for j, h in pairs]
    for pairs in ([(j, j.declared) for j in found.joints], [(j, j.extended) for j in found.joints])
  )
  series = [Bars("declared", BEFORE, before), Bars("extended", AFTER, after)]
  names = [j.joint for j in found.joints]
  return charts.bars(
    "fitted logs by joint, the others prescribed", "RMS of position [mrad or mm]", series, names
  )


def _ladder(found: Identified) -> Section:
  blocks: list[Block] = []
  for item in found.found[:_SHOWN]:
    rows = _hypotheses(item)
    blocks.append(Heading(item.joint))
    header = ["hypothesis", "gain [nats]", "behind [standard errors]", f"left [{_unit(item)}]", ""]
    blocks.append(Table(header, rows))
    series = [Bars("gain", AFTER, [row[1] for row in rows])]
    blocks.append(charts.bars("gain over the constants", "nats", series, [r[0] for r in rows]))
  brief = [
    [j.joint, _label(j.found.best.names), j.found.best.evidence - j.null.evidence]
    for j in found.found[_SHOWN:]
  ]
  if brief:
    blocks.append(Heading("The other joints"))
    blocks.append(Table(["joint", "best", "gain over the constants [nats]"], brief))
  return Section(
    "Evidence",
    "Gain: how much more likely left-out blocks are than with the constants alone. Behind: that"
    " difference to the best hypothesis over its standard error; a name needs every hypothesis that"
    " lacks it to be clearly behind. Left: what the median left-out block leaves.",
    blocks,
  )


def _hypotheses(item: Changed) -> list[list[Any]]:
  """Returns the rows of a joint's evidence: the best of every set of effects, the best first."""
  best, null = item.found.best, item.null
  forced = [s for s in item.ranked if s.beside_force]
  listed = [best, *[s for s in item.alternatives if s is not best][:_LADDER], *forced, null]
  rows = []
  for s in sorted({id(s): s for s in listed}.values(), key=lambda s: -s.evidence):
    alike = any(s is c for c in item.confounded)
    mark = "in the extended model" if s is item.extended else ("as good" if alike else "")
    label = _label(s.names) + (" + a force of any form" if s.beside_force else "")
    left = 1e3 * float(np.sqrt(np.median(s.fit.held[0][0])))
    rows.append([label, s.evidence - null.evidence, clear(best, s), left, mark])
  return rows


def _label(names: frozenset[str]) -> str:
  return " + ".join(sorted(names)) or "constants within tolerances"


_unit = residual_plots.unit_of


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
    f"The extended model, without a force of any form, leaves {1e3 * at['rms']:.3g} {unit} RMS at"
    f" {at['joint']}, most in {at['log']}. The fifth of the samples that holds most of its square:"
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
      j.joint,
      j.verdict,
      1e3 * float(np.sqrt(np.median(j.null.fit.held[0][0]))),
      1e3 * j.left,
      1e3 * j.reference_left,
      ", ".join(
        f"{n} {100 * v:+.1f} %"
        for n, v in j.extended.values(CONSTANTS).items()
        if n not in ("skew", "latency", "zero")
      ),
      1e3 * found.clocks[j.joint].skew,
      1e3 * found.clocks[j.joint].latency,
    ]
    for j in found.joints
  ]
  header = ["joint", "verdict", "constants leave", "effects leave", "the machine leaves anyway"]
  return Section(
    "Joints",
    "What is left of positions in the median block [mrad or mm] by the constants alone and by the"
    " effects found, beside what the machine leaves anyway (its reference, or the noise); the"
    " relative errors of the declared constants, and the latencies of readings and commands that"
    " are taken for the machine's own.",
    [Table([*header, "constants off by", "reading late [ms]", "command late [ms]"], rows)],
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
