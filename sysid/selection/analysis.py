"""Analyses a machine: effects of its scopes, joint by joint, in the form of a report."""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.data.audit import audit
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses.terms import FREE, STICKING
from nerf2real.sysid.model import chains
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.selection import claims, whole_machine
from nerf2real.sysid.selection.findings import Identified, Zero
from nerf2real.sysid.selection.in_machine import in_machine
from nerf2real.sysid.selection.joints import changes, doubts
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.joints.naming import Name
from nerf2real.sysid.selection.joints.subject import WHOLE, Subject, explain_reference, prepare
from nerf2real.sysid.selection.search.evidence import clear
from nerf2real.sysid.selection.wider import loads, scopes, wide, zeros
from nerf2real.sysid.selection.wider.scopes import Shared
from nerf2real.sysid.settings import SETTINGS, Settings

_GRADES = ("none", "effects", "partly", "unexplained")
_PREPARED, _SHARED = 0.2, 0.4  # shares of the work done after constants and wider scopes, about
_ALL_OFF = 0.6  # share of joints with constants that are off that stands for all


def analyse(
  model: mujoco.MjModel,
  logs: Sequence[Log],
  reference: Sequence[Log] = (),
  *,
  machine: Machine | None = None,
  settings: Settings = SETTINGS,
  progress: Progress = no_progress,
) -> Identified:
  """Returns what a machine has that its model, or reference logs, have not.

  A joint that does not move in the logs, or not in the reference, is not judged
  (`Identified.still`).

  Args:
    model: the declared one.
    logs: to identify from.
    reference: logs of the same machine without what is looked for.
    machine: the model along the logs, where it was made before.
    settings: tolerances and effort.
    progress: called with the fraction done and a text.

  Raises:
    ValueError: no joint has an actuator and commands in all logs, and moves.
  """
  machine = machine or Machine(model, logs, window_s=settings.window_s)
  joints = machine.moving(reference)
  if not joints:
    raise ValueError(
      "Found no joint with an actuator that all logs command and that moves, expected at least one."
    )
  before = Machine(model, reference, window_s=settings.window_s) if reference else None
  subjects = []
  for k, joint in enumerate(joints):
    progress(_PREPARED * k / len(joints), f"constants of {joint}, {k + 1} of {len(joints)} joints")
    subjects.append(prepare(joint, machine, before, tried=len(joints), settings=settings))
  shared, changed = _explained(model, subjects, settings, part(progress, _PREPARED, 1.0))
  origins = [s.origin.joint for s in shared]
  changed.sort(
    key=lambda c: (
      -_GRADES.index(c.verdict),
      c.joint not in origins,
      -c.left / max(c.reference_left, 1e-12),
    )
  )
  result = Identified(model, list(logs), changed, audits=[audit(log) for log in logs])
  result.still = [name for name in machine.commanded(reference) if name not in joints]
  for effect in shared:
    _write_shared(result, effect, own_latency=not reference)
  for item in changed:
    _write_down(result, item)
  whole_machine.discard_refuted(result, settings)
  off = [row for row in result.effects if row["kind"] == "parameter_error"]
  if len(off) > _ALL_OFF * len(joints) and len(off) > 1:
    result.effects = [row for row in result.effects if row not in off]
    result.effects.append(claims.constants_of_all(off))
  result.verdict = machine_verdict([c.verdict for c in changed], claimed=bool(result.effects))
  return result


def _explained(
  model: mujoco.MjModel, subjects: Sequence[Subject], settings: Settings, progress: Progress
) -> tuple[list[Shared], list[Changed]]:
  """Returns what joints share and what each has of its own, until nothing shared is needless."""
  alone = part(progress, (_SHARED - _PREPARED) / (1.0 - _PREPARED), 1.0)
  before = [s.state for s in subjects]
  shared: list[Shared] = []
  changed: list[Changed] = []
  refuted: set[str] = set()
  certain: set[str] = set()
  while True:
    known, after = shared, [s.state for s in subjects]
    _set_states(subjects, before)
    if len(subjects) > 1:
      progress(0.0, "effects of bodies and of the whole machine")
      shared = scopes.shared_effects(model, subjects, settings, refuted=refuted, certain=certain)
    if changed and [s.key for s in shared] == [s.key for s in known]:
      shared = known  # what is certain of one joint changes nothing: the explanations stand
      _set_states(subjects, after)
      break
    for subject in subjects:
      if subject.alone or changes.leaves(subject, subject.explainer.null, settings):
        explain_reference(subject, settings)
    changed = []
    for k, subject in enumerate(subjects):
      text = f"explaining {subject.joint}, {k + 1} of {len(subjects)} joints"
      alone(k / len(subjects), text)
      changed.append(changes.explain(subject, settings))
    changed = loads.borne(model, changed, settings)
    needless = scopes.needless(shared, changed)
    fresh = scopes.open_scopes(changed) - certain - refuted
    if not needless and not fresh:
      break
    refuted |= {s.term.kind for s in needless}
    certain |= fresh
  alone(1.0, "what joints share beside what is their own")
  shared, changed = _reopened(model, shared, changed, settings, refuted)
  shared = scopes.with_twins(shared, changed)
  changed = changes.judge_together(zeros.reread(model, changed, settings), settings)
  changes.elaborate(changed)
  return shared, changed


def _set_states(subjects: Sequence[Subject], states: Sequence[tuple[Any, ...]]) -> None:
  """Sets what is known of each joint, and what was scored, to what it was."""
  for subject, state in zip(subjects, states, strict=True):
    subject.state = state


def _reopened(
  model: mujoco.MjModel,
  shared: list[Shared],
  changed: list[Changed],
  settings: Settings,
  refuted: Collection[str],
) -> tuple[list[Shared], list[Changed]]:
  """Returns the same with one more shared effect where what joints have of their own hid it."""
  if len(changed) < 2:
    return shared, changed
  known = {s.term.kind for s in shared} | set(refuted)
  for instead in (None, *sorted(scopes.open_scopes(changed) - known)):
    further = scopes.found_beside(model, changed, settings, known=known, instead=instead)
    if further is not None:
      again = _beside(model, shared, further, changed, settings, simpler=instead is not None)
      if again is not None:
        return [*shared, further], again
  return shared, changed


def _beside(
  model: mujoco.MjModel,
  shared: list[Shared],
  further: Shared,
  changed: list[Changed],
  settings: Settings,
  *,
  simpler: bool,
) -> list[Changed] | None:
  """Returns joints' explanations beside one more shared effect, None where they are not better; for
  one that stands for several joints' own, where they are worse."""
  before = [c.subject.state for c in changed]
  for member in further.members:
    member.take(further.held)
  again = loads.borne(model, [changes.explain(c.subject, settings) for c in changed], settings)
  stands = not scopes.needless([*shared, further], again)
  subjects = [c.subject for c in changed]
  after = [s.state for s in subjects]
  _set_states(subjects, before)
  worth = not scopes.better(changed, again) if simpler else scopes.better(again, changed)
  if not stands or not worth:
    return None
  _set_states(subjects, after)
  return again


def _write_shared(result: Identified, shared: Shared, *, own_latency: bool) -> None:
  """Adds an effect of a body or of the machine."""
  bounds = intervals.around(shared.term, shared.x, *shared.reach, own_latency=own_latency)
  evidence = {
    "clear_by_standard_errors": round(shared.clear, 2),
    "held_out_gain_nats": round(shared.nats, 2),
    "joints": shared.joints,
  }
  zero = None
  if shared.term.kind == zeros.TILT:
    zero = zeros.of_tilt(result.model, shared.x, bounds)
  elif shared.term.kind == wide.ZERO:
    zero = str(shared.term.target), float(shared.x[0]), bounds["offset"]
  if zero is not None:
    joint, offset, (low, high) = zero
    result.zeros[joint] = Zero(offset, (high - low) / (2 * SETTINGS.sigmas))
    slide = _slide(result.model, [joint])
    result.effects.append(claims.zero(joint, offset, (low, high), evidence, slide=slide))
    if shared.term.kind == zeros.TILT:
      result.twins.append(claims.alike(shared.term, shared.x))
    return
  slide = _slide(result.model, shared.joints)
  effect, row = claims.shared(shared.term, shared.x, bounds, evidence, slide=slide)
  if shared.term.kind == "payload":
    carriers = chains.ancestors(result.model, str(shared.term.target))
    row |= {"joint": carriers[0], "body": shared.term.target}
  result.objects.append(effect)
  result.effects.append(row)
  if shared.or_alone is not None:
    result.scopes.append(claims.alone(shared.term, shared.origin.joint, *shared.or_alone))
  result.twins += [claims.alike(term, x) for term, x in shared.alike]


def _slide(model: mujoco.MjModel, joints: Sequence[str]) -> bool:
  """Tells whether all of some joints are slides."""
  return all(model.joint(joint).type[0] == int(mujoco.mjtJoint.mjJNT_SLIDE) for joint in joints)


def machine_verdict(verdicts: Sequence[str], *, claimed: bool) -> str:
  """Returns the machine's verdict, which speaks of effects only where the report claims one.

  Args:
    verdicts: the joints'.
    claimed: whether the report lists an effect.
  """
  kinds = set(verdicts)
  if not claimed:
    return "none" if kinds <= {"none"} else "unexplained"
  return "effects" if kinds <= {"none", "effects"} else "partly"


def _write_down(result: Identified, item: Changed) -> None:
  """Adds a joint's effects, constants and latencies."""
  best = item.extended
  terms = sorted(best.terms, key=lambda t: t.kind == STICKING)  # a friction of its own holds, too
  names = {n.kind: n for n in item.found.names}
  offset = result.zeros.get(item.joint, Zero()).offset
  for term in terms:
    values = best.fit.values(term)
    if term.kind == CONSTANTS:
      result.clocks[item.joint] = Clocks(values.get("skew", 0.0), values.get("latency", 0.0))
      effect = term.effect(np.array(list(values.values())))
      effect = dataclasses.replace(effect, target=item.joint)
      result.calibration.append(in_machine(effect, best))
      offset += values.get("zero", 0.0)
      if term.freed or item.constants_off:
        evidence = _evidence(item, names.get("parameter_error"))
        _list(result, item, "parameter_error", claims.effect(item, term, evidence)[1])
      continue
    if term.kind == STICKING:
      sticks = Effect("coulomb_friction", item.joint, {"torque": 0.0})
      if not any(e.kind == sticks.kind and e.target == item.joint for e in result.objects):
        result.objects.append(sticks)
      continue
    if not term.names:  # of a wider scope
      continue
    if term.kind == FREE:
      effect, row = claims.free(item, term)
      result.objects.append(in_machine(effect, best))
      result.nearest.append(row)
      continue
    # What the reference has, too, is in the baseline that evidence is counted from.
    evidence = {} if term.known else _evidence(item, names.get(term.kind))
    effect, row = claims.effect(item, term, evidence)
    if term.kind == "encoder_offset":
      offset += float(effect.parameters["offset"])  # type: ignore[arg-type]
    else:
      result.objects.append(in_machine(effect, best))
    if term.known:
      if doubts.exceeds(item.subject, best, term):
        result.in_reference.append(row)
    else:
      _list(result, item, term.kind, row)
  if offset:
    result.objects.append(Effect("encoder_offset", item.joint, {"offset": offset}))
  result.objects[:] = _once(result.objects)


def _list(result: Identified, item: Changed, kind: str, row: dict[str, Any]) -> None:
  """Adds an entry to what is claimed, or to what is only in the extended model."""
  named = kind in item.named or (kind == "parameter_error" and item.constants_off)
  stands = named and item.verdict in ("effects", "partly")
  (result.effects if stands else result.nearest).append(row)


def _evidence(item: Changed, name: Name | None) -> dict[str, Any]:
  return {
    "clear_by_standard_errors": round(min(name.clear, 999.0), 2) if name else None,
    "clear_of_the_baseline": round(clear(item.found.best, item.null), 2),
    "share_explained": round(item.found.share, 4),
    "share_explained_low": round(item.found.share_low, 4),
    "left_over_reference": round(item.left / max(item.reference_left, 1e-12), 3),
    "constants_alone_left": round(float(np.sqrt(np.median(item.null.fit.held[0][0]))), 6),
    "held_out_gain_nats": round(item.found.best.evidence - item.null.evidence, 2),
  }


def _once(effects: Sequence[Effect]) -> list[Effect]:
  """Returns effects without repetitions of those that concern the whole machine."""
  seen: set[tuple[str, str | None]] = set()
  result = []
  for effect in effects:
    key = (effect.kind, None if effect.kind in WHOLE else effect.target)
    if key not in seen:
      seen.add(key)
      result.append(effect)
  return result
