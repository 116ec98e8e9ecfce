"""The page of a closed loop: five numbers, and the story in pictures, from failure to recovery."""

import json
from collections.abc import Sequence
from pathlib import Path

from nerf2real.core.floor_map import FloorMap
from nerf2real.core.pages import charts, page
from nerf2real.core.pages.blocks import (
  Block,
  Details,
  Figure,
  Figures,
  Grid,
  Legend,
  Picture,
  Preformatted,
  Table,
  Text,
  Times,
)
from nerf2real.core.pages.page import Section
from nerf2real.core.serialization import to_plain
from nerf2real.evaluation.episodes import OUTCOMES
from nerf2real.evaluation.loop import entering
from nerf2real.evaluation.loop import story as loop
from nerf2real.evaluation.loop.comparing import Comparison, describe
from nerf2real.evaluation.loop.naming import Named
from nerf2real.evaluation.loop.story import Story
from nerf2real.evaluation.loop.teachers import ADAPTED
from nerf2real.evaluation.loop.trials import Tally
from nerf2real.evaluation.report import maps
from nerf2real.suite.effects import kind_of
from nerf2real.suite.scene import open_scene

_HEIGHT = 360  # of maps [pixel]
_NOTHING = "-"
_SIDE_BY_SIDE = (
  "By the clock, of each stage. Where trials under different conditions ran side by side the total "
  "is more than the whole took."
)
_ENOUGH = "3,000 or more; 1,400 on a machine with other work brought nothing back"


_LEAD = (
  "A policy meets a robot with something that nobody declared: the robot's own recordings name it, "
  "the simulation gets it, and the policy is trained on."
)
_VIRTUAL = " Robot means a virtual robot here; no figure of this page is of hardware."


def write(path: Path, story: Story) -> None:
  """Writes the page."""
  floor = maps.draw_floor(open_scene(story.settings.scene), height=_HEIGHT)
  before, simulated, after = (
    _paths(story, floor, title, text, names)
    for title, text, names in (
      (
        "Before",
        "Paths of the same trials, seen from above; a dot is where a failure ended.",
        (loop.HEALTHY, loop.BEFORE),
      ),
      (
        "In the simulation",
        "The same trials without and with the effects, drawn from their intervals every episode: "
        f"where the finding is right, the policy fails here as on the robot. {_gaps(story)}",
        (loop.NOMINAL, loop.WITH_EFFECTS),
      ),
      ("After", "The same trials on the same robot.", (loop.BEFORE, loop.AFTER)),
    )
  )
  settings = Preformatted(json.dumps(to_plain(story.settings), indent=1))
  sections = [
    Section(
      "Five numbers",
      "Success: share of the trials, with their count and the exact 95 % interval.",
      [Figures(five_numbers(story))],
    ),
    before,
    _finding(story.named),
    simulated,
    _training(story),
    after,
    _outcomes(list(story.tallies.values()), _cooled(story)),
    *([] if story.comparison is None else [_hidden(story.comparison)]),
    Section("Time", _SIDE_BY_SIDE, [Times(story.times)]),
    Section("Settings", "", [Details("all", [settings])]),
  ]
  lead = _LEAD + (_VIRTUAL if story.settings.robot == "virtual" else "")
  page.write(path, page.Page("The loop closed", lead, sections, origin=page.Origin.of_process()))


def five_numbers(story: Story) -> list[Figure]:
  """Returns success as the robot was, before, in the simulation with effects, after; what came
  back."""
  tallies = story.tallies
  share = loop.recovered(story)
  wanted = (
    (loop.HEALTHY, "without what was hidden", "higher"),
    (loop.BEFORE, "with it", "higher: little was lost"),
    (loop.WITH_EFFECTS, "the same trials with what was named", "near before: the name is right"),
    (loop.AFTER, "trained on with what was named", "near the robot's without what was hidden"),
  )
  figures = [
    Figure(
      f"success, {name}",
      _percent(tallies.get(name)),
      "",
      meaning,
      good,
    )
    for name, meaning, good in wanted
  ]
  value = "nothing was lost" if loop.HEALTHY in tallies else _NOTHING
  if share is not None:  # of how few it is says what a share is worth
    count = round(loop.lost(tallies) * tallies[loop.BEFORE].trials)
    value = f"{100 * share:.0f} % of {count} trial{'s' if count > 1 else ''}"
  back = "after less before, of what was lost"
  return [*figures, Figure("lost success that came back", value, "", back, "100 %")]


def as_text(story: Story) -> str:
  """Returns the numbers, and what was named beside what was hidden, in lines."""
  lines = [f"{f.name}: {f.value}" for f in five_numbers(story)]
  if story.comparison is not None:
    rows = story.comparison.rows
    lines += [f"hidden: {row.hidden}; named: {row.named or 'nothing'}" for row in rows]
    lines += [f"named besides: {'; '.join(story.comparison.wrong) or 'nothing'}"]
    lines += [f"in the reference, too: {found}" for found in story.comparison.in_reference]
  return "\n".join(["", *lines])


def _gaps(story: Story) -> str:
  """Returns how far the simulation's success is from the robot's, in words."""
  parts = [f"{100 * gap.success:+.0f} points ({name})" for name, gap in loop.gaps(story).items()]
  return f"Success against the robot's before: {', '.join(parts)}."


def _percent(found: Tally | None) -> str:
  return _NOTHING if found is None else str(found)


def _paths(story: Story, floor: FloorMap, title: str, text: str, names: Sequence[str]) -> Section:
  cells = [
    Picture(maps.draw_paths(floor, story.episodes[name]), f"{name}: {story.tallies[name]}")
    for name in names
    if name in story.episodes
  ]
  return Section(title, text, [Legend({o: maps.COLORS[o] for o in OUTCOMES}), Grid(cells, 2)])


def _finding(named: Named) -> Section:
  blocks: list[Block] = []
  if named.entering:
    reasons = entering.reasons(named.entering, named.content)
    rows = [
      (
        e.kind,
        e.target or "all",
        name,
        value,
        *e.intervals.get(name, (_NOTHING, _NOTHING)),
        kind_of(e.kind).parameter(name).unit,
        why,
      )
      for e, why in zip(named.entering, reasons, strict=True)
      for name, value in e.parameters.items()
      if isinstance(value, int | float)
    ]
    header = ("effect", "where", "parameter", "value", "low", "high", "unit", "why")
    table = Table(header, rows)
    blocks.append(Text(_entering(named)))
    blocks.append(table if len(rows) <= 12 else Details(f"all {len(rows)} values", [table]))
  if named.left_out:
    blocks.append(Details(f"what stays out: {len(named.left_out)}", [Text(_left_out(named))]))
  held = named.content["error"]["held"]
  share = _NOTHING if named.share is None else f"{100 * named.share:.0f} %"
  noise = named.content["error"]["floor"]
  blocks.append(
    Text(
      f"Held-out error of joint positions: declared model {1e3 * held['before']:.2f} mrad, "
      f"extended {1e3 * held['after']:.2f} mrad, noise {1e3 * noise:.2f} mrad. "
      f"Share of the squared error above the noise that is explained: {share}."
    )
  )
  listed = "; ".join(describe(e) for e in named.named) or "nothing"
  own = "; ".join(describe(e) for e in named.in_reference)
  if own:
    blocks.append(Text(f"In the reference, too, so that the robot had it before: {own}."))
  if named.notes:
    blocks.append(Details(f"notes: {len(named.notes)}", [Text(note) for note in named.notes]))
  return Section("What the recordings say", f"Verdict: {named.verdict}. Named: {listed}.", blocks)


def _entering(named: Named) -> str:
  """Returns what the simulation gets and what not, in words."""
  text = (
    "The simulation gets what is named, what the robot had before, too, and what was fitted beside "
    "a name at its joint (declared constants, friction, zero), each drawn from its interval (95 %)"
  )
  if named.forces:
    joints = ", ".join(str(force.target) for force in named.forces)
    text += f"; and as no name explains the motion, learned forces at {joints}"
  if not named.left_out:
    return f"{text}."
  return (
    f"{text}. The {len(named.left_out)} other effects of the analyser's extended model stay out: "
    "they make its errors smaller in the air, and nothing has judged them under weight."
  )


def _left_out(named: Named) -> str:
  """Returns the effects that stay out, by kind."""
  places: dict[str, list[str]] = {}
  for effect in named.left_out:
    places.setdefault(effect.kind, []).append(effect.target or "all")
  return "; ".join(f"{kind} at {', '.join(listed)}" for kind, listed in places.items()) + "."


def _training(story: Story) -> Section:
  if story.trained is None:
    named = story.named.named or story.named.forces
    why = "No success was lost in these trials" if named else "Nothing was named"
    return Section("Trained on", f"{why}: the policy stays as it was.")
  made = story.trained
  chosen = "; ".join(f"{n}: {k} of {made.trials}" for n, k in made.teachers.items())
  figures = [
    Figure("training", round(made.minutes, 1), "min", "of updates"),
    Figure("updates", made.updates, "", "of the student in these minutes", _ENOUGH),
    Figure("frames", made.frames, "", "control steps collected"),
    Figure(
      "teacher",
      "adapted" if Path(made.teacher).name == ADAPTED else Path(made.teacher).name,
      "",
      f"walkers with the effects: {chosen}" if chosen else "",
    ),
    Figure(
      "success in the simulation with the effects",
      _percent(story.tallies.get(loop.TRAINED)),
      "",
      "of the policy that was trained on",
      "near that of the robot without what was hidden",
    ),
  ]
  return Section("Trained on", "Distillation, effects drawn every episode.", [Figures(figures)])


def _cooled(story: Story) -> str:
  """Returns which sessions the robot's heat ended, in words."""
  ended = [
    f"{name}, after {one.trials} trials: {one.detail}"
    for name, listed in story.cooled.items()
    for one in listed
  ]
  text = "Sessions that a hot joint ended; the trials went on with a cool robot"
  return f"{text}: {'; '.join(ended)}." if ended else ""


def _outcomes(tallies: Sequence[Tally], text: str) -> Section:
  names = [found.name for found in tallies]
  series = [
    charts.Bars(
      outcome, maps.COLORS[outcome], [100 * t.outcomes[outcome] / t.trials for t in tallies]
    )
    for outcome in OUTCOMES
  ]
  chart = charts.bars("Outcomes by condition", "per cent of trials", series, names, stacked=True)
  rows = [
    (
      t.name,
      t.trials,
      *(t.outcomes[o] for o in OUTCOMES),
      f"{100 * t.low:.0f} to {100 * t.high:.0f}",
    )
    for t in tallies
  ]
  header = ("condition", "trials", *OUTCOMES, "success, 95 % interval [%]")
  return Section("How the trials ended", text, [chart, Table(header, rows)])


def _hidden(found: Comparison) -> Section:
  rows = [
    (
      row.hidden,
      row.named or "nothing",
      "yes" if row.right else "no",
      _NOTHING if row.covered is None else ("yes" if row.covered else "no"),
    )
    for row in found.rows
  ]
  header = ("hidden", "named", "right", "intervals hold the value")
  text = "Nothing was hidden." if not rows else ""
  besides = "; ".join(found.wrong) or "nothing"
  blocks: list[Block] = [Table(header, rows)] if rows else []
  blocks.append(Text(f"Named besides: {besides}."))
  if found.in_reference:
    own = "; ".join(found.in_reference)
    blocks.append(Text(f"In the reference, too, and neither right nor wrong: {own}."))
  return Section("What was hidden", text, blocks)
