"""What identification says of a robot's recordings: the one place that calls the analyser.

The rest of the loop depends on `Named` alone: verdict, effects with intervals, what is explained.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nerf2real import sysid
from nerf2real.core.files import write_atomically
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.core.serialization import write_json
from nerf2real.evaluation.loop.entering import CONSTANTS, UNEXPLAINED, entering, forces, is_listed
from nerf2real.evaluation.loop.robot import starts
from nerf2real.evaluation.loop.robot.motions import HELD, TRAIN, declared_model, standing_model
from nerf2real.evaluation.loop.robot.recording import FLOOR
from nerf2real.evaluation.loop.robot.starts import Walked
from nerf2real.suite.effects import Effect, read_effects, write_effects
from nerf2real.suite.op3.constants import TORSO_LINK
from nerf2real.sysid.sensors import floor
from nerf2real.sysid.sensors.sensed import Part
from nerf2real.sysid.sensors.walks import finding
from nerf2real.sysid.sensors.walks.replay import Walk

NONE = "none"
_ALL, _ENTERING = "effects.json", "entering.json"  # of the extended model; what enters simulation
_FINDING = "finding.json"  # the loop's own file: written last, so that it stands for a whole stage
Walks = Sequence[Sequence[Walk]]  # log by log


class Named(NamedTuple):
  """A finding."""

  verdict: str  # "none", "effects", "unexplained", ...
  content: dict[str, Any]  # of the analyser's report.json
  effects: list[Effect]  # of the extended model, named or not, with intervals; constants, too
  effects_path: Path  # effects.json
  entering: list[Effect]  # those of them that the simulation gets
  entering_path: Path  # as a file
  share: float | None  # of the held-out squared error above the noise, explained
  notes: list[str]
  seconds: float  # of the analysis

  @property
  def named(self) -> list[Effect]:
    """The effects that are claimed, without errors of declared constants."""
    rows = self.content.get("effects")
    return [
      effect
      for effect in self.effects
      if effect.kind not in CONSTANTS and (rows is None or is_listed(effect, rows))
    ]

  @property
  def forces(self) -> list[Effect]:
    """The learned forces that stand in for names where the motion is unexplained."""
    return forces(self.effects, self.content)

  @property
  def left_out(self) -> list[Effect]:
    """The effects of the extended model that the simulation does not get."""
    return [effect for effect in self.effects if effect not in self.entering]

  @property
  def in_reference(self) -> list[Effect]:
    """The effects that the reference shows, too: the robot's own build."""
    rows = self.content.get("in_reference", ())
    own = [effect for effect in self.effects if is_listed(effect, rows)]
    return [effect for effect in own if effect not in self.named]


def name(
  out: Path,
  logs: Path,
  reference: Path | None = None,
  *,
  walked: Walked | None = None,
  walked_before: Walked | None = None,
) -> Named:
  """Identifies what a robot's logs show beyond the declared model, or reads what was found.

  Args:
    out: Folder of the analyser's files.
    logs: Folder with the logs of `recording.record_stand`, and with `floor.mcap` if there is one.
    reference: Folder with logs of the same robot from before; they calibrate the constants.
    walked: The robot's trials, which show the floor's slope better than `floor.mcap`, and with
      those from before friction under weight and slip.
    walked_before: Those of the same robot from before.

  Raises:
    ValueError: The logs cannot be identified from.
  """
  if not (out / _FINDING).exists():
    out.mkdir(parents=True, exist_ok=True)
    model = out / "declared.xml"
    write_atomically(model, declared_model())
    content = sysid.identify(
      model,
      [logs / f"{name}.mcap" for name in TRAIN],
      held=[logs / f"{name}.mcap" for name in HELD],
      reference=[] if reference is None else [reference / f"{name}.mcap" for name in TRAIN],
      out=out,
    )
    trials = [None if one is None else starts.read(one) for one in (walked, walked_before)]
    stood = _slope(logs, reference, *trials)
    effects = read_effects(out / _ALL)
    if any(effect.kind == "floor_slope" for effect in stood.effects):  # gravity is turned once
      effects = [effect for effect in effects if effect.kind != "gravity_tilt"]
    effects += stood.effects
    _add(content, stood)
    trodden = _walking(content, effects, *trials)
    _add(content, trodden)
    effects += trodden.effects
    write_effects(out / _ALL, effects)
    write_effects(out / _ENTERING, entering(effects, content))
    write_json(out / _FINDING, content)
  return read(out)


def read(out: Path) -> Named:
  """Reads what `name` found; of a loop that began with all effects, all enter the simulation."""
  content = json.loads((out / _FINDING).read_text())
  path = out / _ENTERING if (out / _ENTERING).exists() else out / _ALL
  return Named(
    verdict=content["verdict"],
    content=content,
    effects=read_effects(out / _ALL),
    effects_path=out / _ALL,
    entering=read_effects(path),
    entering_path=path,
    share=_share(content["error"]),
    notes=list(content["notes"]),
    seconds=float(content["seconds"]),
  )


def _share(error: dict[str, Any]) -> float | None:
  """Returns 1 - (after^2 - noise^2) / (before^2 - noise^2) of the held-out error, within [0, 1]."""
  held, noise = error.get("held"), error.get("floor") or 0.0
  if not held or held["before"] <= noise:
    return None
  left = max(held["after"] ** 2 - noise**2, 0.0)
  return max(0.0, 1.0 - left / (held["before"] ** 2 - noise**2))


def _add(content: dict[str, Any], part: Part) -> None:
  """Adds what a sensor says to a report."""
  if part.rows:
    content["verdict"] = {NONE: "effects", UNEXPLAINED: "partly"}.get(
      content["verdict"], content["verdict"]
    )
  content["effects"] = [*content["effects"], *part.rows]
  content["in_reference"] = [*content["in_reference"], *part.in_reference]
  content["notes"] = [*content["notes"], *part.notes]


def _walking(
  content: Mapping[str, Any], effects: Sequence[Effect], now: Walks | None, before: Walks | None
) -> Part:
  """Returns what the trials' walks show that those of before did not: friction under weight, slip.

  Args:
    content: Of the report.
    effects: What is known of the robot by now.
    now: Its walks, log by log.
    before: Those of the same robot from before.
  """
  if now is None or before is None:
    return Part()
  changed = [e for e in effects if e.kind not in CONSTANTS and is_listed(e, content["effects"])]
  model = standing_model()
  return finding.find(
    model,
    model.body(TORSO_LINK).id,
    finding.Recordings([walk for log in now for walk in log], effects),
    finding.Recordings(
      [walk for log in before for walk in log], [e for e in effects if e not in changed]
    ),
  )


def _slope(logs: Path, reference: Path | None, now: Walks | None, before: Walks | None) -> Part:
  """Returns the floor's slope: from the trials where those of now and before tell it, both alike in
  the room's axes, else from turning."""
  given = [now] if reference is None else [now, before]
  parts = [None if one is None else starts.find(one) for one in given]
  if not all(part is not None and part.estimates for part in parts):
    parts = [_floor(folder / f"{FLOOR}.mcap") for folder in (logs, reference) if folder is not None]
  found = parts[0] or Part()
  return found if len(parts) == 1 else found.beside(parts[1] or Part())


def _floor(log: Path) -> Part:
  """Returns what a robot that stood at several headings shows of the floor's slope."""
  if not log.exists():
    return Part()
  return floor.find(standing_model(), [read_log(log)]) or Part()
