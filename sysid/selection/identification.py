"""From a declared model and logs to a verdict: `sysid.identify`.

audit -> screening of joints -> race on the suspects -> decision -> intervals -> learned force where
nothing fits -> error of the declared and the extended model by MuJoCo -> files.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.data.audit import audit
from nerf2real.sysid.data.compatibility import check_against_model
from nerf2real.sysid.data.opening import named, read_log
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.selection import (
  analysis,
  chain,
  claims,
  common,
  decision,
  detection,
  learned,
  race,
  screening,
)
from nerf2real.sysid.selection.decision import Thresholds
from nerf2real.sysid.selection.explanation import Effort, Ladder, even_out
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joint import (
  Found,
  decide,
  gain_on_left_out,
  look_again,
  race_joint,
  without_nothing,
)
from nerf2real.sysid.selection.race import Entry
from nerf2real.sysid.selection.screening import Screened
from nerf2real.sysid.selection.subject import WHOLE

Array = np.ndarray

_HEALTHY = 0.7  # nats above the noise that joints without an effect leave at most; ours
_FEW = 5  # joints of which half may have something
_ALL_OFF = 0.6  # share of joints with constants that are off that stands for all
_MOSTLY = 2 / 3  # of what a machine's joints leave, in nats, that must be explained to be a verdict


@dataclasses.dataclass(frozen=True)
class Settings:
  """How an identification is done."""

  thresholds: Thresholds = Thresholds()
  """When a hypothesis is believed."""
  effort: Effort = Effort()
  """How much is computed."""
  suspects: int = 3
  """Joints of several that are raced, those that the null model explains least."""
  suspicious: float = 0.12
  """nats above the median joint at which a joint is raced."""
  window_s: float = 0.5
  """Length of the windows where an actuator does not hold position."""
  seed: int = 0
  """Of resampling."""


def load_model(path: Path) -> mujoco.MjModel:
  """Reads a MuJoCo model; a file that is missing or wrong is one clear error."""
  if not Path(path).is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a MuJoCo model (.xml).")
  try:
    return mujoco.MjModel.from_xml_path(str(path))
  except ValueError as error:
    first = str(error).strip().splitlines()[0]
    raise ValueError(f"{path} is not a MuJoCo model: {first}") from error


def read_logs(paths: Sequence[Path], model: mujoco.MjModel) -> list[Log]:
  """Reads logs and checks them against the model."""
  logs = []
  for path in paths:
    log = named(read_log(path), model)
    check_against_model(log, model)
    logs.append(log)
  return logs


def analyse(
  model: mujoco.MjModel,
  logs: list[Log],
  *,
  reference: Sequence[Log] = (),
  settings: Settings | None = None,
  progress: Progress = no_progress,
) -> Identified:
  """Finds what a model lacks.

  Beside references by evidence that adds up (`analysis`); without, that decides on several joints
  where what it names is all there is, and the ladder (`_by_ladder`) elsewhere: where more remains,
  a name may be that of a force like it, which the ladder is stricter with.
  """
  settings = settings or Settings()
  if reference or len(logs[0].commands.joints) > 1:
    progress(0.0, "comparing with the reference" if reference else "explaining every joint")
    found = analysis.analyse(model, logs, reference)
    if reference or found.verdict == "effects":
      return found
  return _by_ladder(model, logs, settings, progress)


def _by_ladder(
  model: mujoco.MjModel, logs: list[Log], settings: Settings, progress: Progress
) -> Identified:
  """Finds what a model lacks by a ladder of hypotheses and thresholds on it."""
  progress(0.0, "looking for joints whose residual stands out")
  screened = screening.screen(model, logs, window_s=settings.window_s)
  if not screened:
    raise ValueError(
      "Found no joint with an actuator that all logs command, expected at least one."
    )
  common.expect_like_the_others(screened)
  found = _race(screened, settings, part(progress, 0.1, 0.8))
  progress(0.8, "comparing the joints")
  chain.without_refuted(model, found, screened, settings.thresholds)
  found = _without_contradictions(found, settings)
  found += _others(found, screened, settings)
  result = Identified(model, logs, screened, found, audits=[audit(log) for log in logs])
  _conclude(result, settings)
  return result


def _race(screened: list[Screened], settings: Settings, progress: Progress) -> list[Found]:
  screened.sort(key=lambda s: -s.excess)
  suspects, found = _suspects(screened, settings), []
  for index, suspect in enumerate(suspects):
    progress(index / len(suspects), f"hypotheses for {suspect.joint}")
    found.append(race_joint(suspect, settings.thresholds, settings.effort, seed=settings.seed))
  return found


def _suspects(screened: list[Screened], settings: Settings) -> list[Screened]:
  """Returns the joints to race: those above the others, at least the first."""
  if len(screened) <= 2:
    return screened[: settings.suspects]
  left = [s.excess for s in screened]
  usual = float(np.median(left) if len(left) > _FEW else np.min(left))
  usual = min(usual, _HEALTHY)  # what all have is no usual thing
  high = [s for s in screened if s.excess > usual + settings.suspicious]
  return (high or screened[:1])[: settings.suspects]


def _without_contradictions(found: list[Found], settings: Settings) -> list[Found]:
  """Demotes kinds that concern all joints where another joint does not show them."""
  if len(found) < 2:
    return found
  for item in found:
    for kind in WHOLE:
      holders = [f for f in found if kind in decision.names(f.finding.chosen)]
      if item in holders and len(holders) < len(found):
        ladder = item.ladder
        ladder.singles = [e for e in ladder.singles if kind not in decision.names(e)]
        ladder.pairs = [e for e in ladder.pairs if kind not in decision.names(e)]
        item.finding = decide(ladder, item.thresholds)
  return found


def _others(found: list[Found], screened: list[Screened], settings: Settings) -> list[Found]:
  """Looks for what several raced joints have in the joints that were not raced.

  A machine's servos are of one kind: what two of them have, the others are asked for too.
  """
  shared: dict[str, Entry] = {}
  for item in found:
    for kind in decision.names(item.finding.chosen) if item.finding.named else ():
      same = [f for f in found if f.finding.named and kind in decision.names(f.finding.chosen)]
      single = [e for e in item.ladder.singles if decision.names(e) == {kind}]
      if len(same) > 1 and kind not in (*WHOLE, "payload") and single:
        shared.setdefault(kind, single[0])
  raced = {f.screened.joint for f in found}
  result = []
  for s in screened:
    if s.joint in raced or not shared:
      continue
    entries = []
    for entry in shared.values():
      term = dataclasses.replace(entry.fit.terms[-1], target=s.joint)
      start = np.concatenate([s.null.fit.x, entry.fit.part(len(entry.fit.terms) - 1)])
      entries.append(race.entry(s.problem, s.problem.fit([s.calibration, term], start)))
    entries.sort(key=lambda e: e.score)
    ladder = Ladder(s.problem, s.calibration, s.declared, s.null, entries, [])
    even_out(ladder)
    finding = decide(ladder, settings.thresholds)
    if finding.named:
      chance = detection.chance_gain(s.problem, s.null, entries, seed=settings.seed)
      result.append(Found(s, ladder, finding, chance, settings.thresholds))
  return result


def _conclude(result: Identified, settings: Settings) -> None:
  """Fills in verdict, effects, calibration and clocks."""
  chain.merge_payloads(result.model, result.found, settings.thresholds)
  named = [f for f in result.found if f.finding.named]
  spread = screening.shared_spread(
    result.screened, named[0].finding.chosen if len(result.screened) == 1 and named else None
  )
  chosen = {s.joint: s.null for s in result.screened}
  for item in result.found:
    done = item.finding.verdict == "unexplained" and look_again(item)
    fit_on = item.finding.named and not done
    chosen[item.joint] = without_nothing(item, spread) if fit_on else item.finding.chosen
  for item in (f for f in result.found if f.finding.named):
    entry = chosen[item.joint]
    held_out = gain_on_left_out(item.ladder, entry)
    for term in entry.fit.terms:
      if term.kind != "calibration" and not claims.is_idle(entry, term):
        claim = claims.effect(item, entry, term, held_out)
        _claim(result, claim, sure=item.finding.verdict != "unexplained")
  off: list[dict[str, Any]] = []
  for s in result.screened:
    fit = chosen[s.joint].fit
    values = fit.values("calibration")
    result.clocks[s.joint] = Clocks(values.get("skew", 0.0), values.get("latency", 0.0))
    calibration = fit.terms[0].effect(fit.part(0))
    result.calibration.append(dataclasses.replace(calibration, target=s.joint))
    if decision.constants_off(chosen[s.joint], s.declared, s.null, settings.thresholds):
      off.append(claims.constants(s, chosen[s.joint]))
  alike = len(off) > _ALL_OFF * len(result.screened) and len(off) > 1
  result.effects += [claims.constants_of_all(off)] if alike else off
  for item in result.unexplained:
    force, _, _ = learned.learn(item.screened.problem, chosen[item.joint].fit)
    if force is not None:
      result.learned.append(force)
  if result.unexplained and not _mostly_explained(result.found):
    result.verdict = "unexplained"
  elif result.effects:
    result.verdict = "effects"


def _mostly_explained(found: Sequence[Found]) -> bool:
  """Tells whether what the joints leave is mostly that of joints with effects that were named.

  One joint of twenty that nothing fits does not take the names from the others; a fault of one
  joint that its neighbours feel is not explained by what imitates it there.
  """
  left = {verdict: 0.0 for verdict in ("effects", "unexplained", "none")}
  for item in found:
    left[item.finding.verdict] += max(item.screened.excess, 0.0)
  return left["effects"] > _MOSTLY * (left["effects"] + left["unexplained"])


def _claim(result: Identified, claim: claims.Claim, *, sure: bool = True) -> None:
  effect, row = claim
  if not any(e.kind == effect.kind and e.target == effect.target for e in result.objects):
    result.objects.append(effect)
    (result.effects if sure else result.nearest).append(row)
