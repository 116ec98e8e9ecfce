"""drift.html: whether a stored result still holds, in a sentence, in tables and in pictures."""

from collections.abc import Sequence

from nerf2real.core import palette
from nerf2real.core.pages import charts
from nerf2real.core.pages.blocks import Answer, Answers, Grid, Table
from nerf2real.core.pages.charts import Curve
from nerf2real.core.pages.page import Origin, Page, Section
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.drift.judgement import Drift, Error
from nerf2real.sysid.drift.stored import Stored
from nerf2real.sysid.drift.values import Value
from nerf2real.sysid.model import simulation

_SHOWN = 6  # joints whose residuals are drawn, those that have grown most first


def sentence(found: Drift) -> str:
  """Returns the judgement in one sentence."""
  words = "The stored result still holds" if found.holds else "The machine has drifted"
  return f"{words}: {'; '.join(_grounds(found))}."


def _grounds(found: Drift) -> list[str]:
  """Returns what the judgement rests on, in words."""
  if not found.holds:
    return [_moved(value) for value in found.moved] + [_grown(error) for error in found.grown]
  worst = max(found.errors, key=lambda e: e.later / e.expected)
  words = [f"it leaves {_size(worst.later, worst)} at {worst.joint}"]
  words[0] += f", up to {_size(worst.expected, worst)} are expected"
  shown = [value for value in found.values if value.state == "fits"]
  if shown:
    words.append(f"within the stored intervals: {_named(shown)}")
  hidden = [value for value in found.values if value.state == "not shown"]
  if hidden:
    words.append(f"not shown by these logs: {_named(hidden)}")
  return words


def _moved(value: Value) -> str:
  assert value.later is not None
  then, now = (f"{v:.3g} ({low:.3g} to {high:.3g})" for v, low, high in (value.stored, value.later))
  return f"{value.kind} {value.name} at {value.where} is {now} {value.unit}, stored {then}"


def _grown(error: Error) -> str:
  expected = f"at most {_size(error.expected, error)} were expected"
  return f"{error.joint} leaves {_size(error.later, error)}, {expected}"


def _size(value: float, error: Error) -> str:
  return f"{1e3 * value:.3g} m{error.unit}"


def _named(values: Sequence[Value]) -> str:
  return ", ".join(f"{value.kind} {value.name}" for value in values)


def page(found: Drift, stored: Stored, logs: Sequence[Log]) -> Page:
  """Returns the page.

  Args:
    found: the judgement.
    stored: the result that was judged.
    logs: the later ones.
  """
  sections = [_answer(found), _errors(found)]
  if found.values:
    sections.append(_values(found))
  sections.append(_residuals(found, stored, logs))
  notes = [f"Not compared: {kind}." for kind in found.not_judged]
  return Page(
    "A stored result and later logs",
    f"{len(logs)} later {'log' if len(logs) == 1 else 'logs'}: does what was found still hold?",
    sections,
    notes,
    origin=Origin.of_process(),
  )


def _answer(found: Drift) -> Section:
  answer = "Yes" if found.holds else "No, the machine has drifted"
  words = [f"{ground[:1].upper()}{ground[1:]}." for ground in _grounds(found)]
  tone = "good" if found.holds else "warn"
  question = "Does the stored result still hold?"
  return Section("In short", "", [Answers([Answer(question, answer, words, tone)])])


def _errors(found: Drift) -> Section:
  header = ["joint", "stored", "expected up to", "later", "noise then", "noise now", ""]
  rows = [
    [
      f"{e.joint} [m{e.unit}]",
      *(1e3 * v for v in (e.stored, e.expected, e.later, e.noise_stored, e.noise_later)),
      "has grown" if e.grown else "as expected",
    ]
    for e in found.errors
  ]
  return Section(
    "Error",
    "RMSE of the position, each joint simulated along the motion of the others, with what was"
    " stored and nothing fitted. Expected: what a further log of the same machine leaves, by how"
    " much the stored logs differ among themselves; what the readings are noisier by is taken off.",
    [Table(header, rows)],
  )


def _values(found: Drift) -> Section:
  rows = []
  for value in found.values:
    then, now = (
      "" if entry is None else f"{entry[0]:.4g} ({entry[1]:.4g} to {entry[2]:.4g})"
      for entry in (value.stored, value.later)
    )
    label = f"{value.kind} {value.name} ({value.where})"
    rows.append([label, then, now, value.unit, value.apart, value.state])
  header = ["value", "stored (95 %)", "now (95 %)", "unit", "apart [standard errors]", ""]
  return Section(
    "Values",
    "The named values alone fitted anew to the later logs, each joint's constants within what two"
    " recordings of one machine differ by.",
    [Table(header, rows)],
  )


def _residuals(found: Drift, stored: Stored, logs: Sequence[Log]) -> Section:
  window = stored.content["window_s"] or 0.5
  best = stored.near[0]
  shown = sorted(found.errors, key=lambda e: -e.later / e.expected)[:_SHOWN]
  figures = []
  for log in logs:
    assert log.states.position is not None
    left = log.states.position - simulation.simulate(
      stored.model, log, best.effects, clocks=best.clocks, window_s=window
    )
    for error in shown:
      row = 1e3 * left[:, log.states.column(error.joint)]
      curves = [Curve("residual", palette.BLUE, log.states.stamp, row)]
      title = f"{log.name}: {error.joint}, RMSE expected up to {_size(error.expected, error)}"
      figures.append(charts.lines(title, "time [s]", f"residual [m{error.unit}]", curves))
  return Section(
    "Residuals of the later logs",
    "Measured minus simulated position of the whole machine under the stored extended model.",
    [Grid(figures, min(2, len(figures)))],
  )
