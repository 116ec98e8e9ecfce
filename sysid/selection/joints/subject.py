"""One joint of a machine under analysis: its logs, and what is known of it beforehand.

With reference logs the joint's constants and the effects that it has anyway are found there first;
without, the constants are the declared ones within their tolerances.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.efforts import Duties, Torques
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.servo.law import ServoLaw
from nerf2real.sysid.selection.joints.baseline import (
  changed_constants,
  freed_constants,
  known_terms,
  widened,
)
from nerf2real.sysid.selection.joints.naming import conclude, thresholds
from nerf2real.sysid.selection.joints.reference import reference_constants
from nerf2real.sysid.selection.joints.remainder import structured
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.selection.search.growth import grow
from nerf2real.sysid.settings import Settings

WHOLE = ("clock_drift", "supply_sag", "gravity_tilt")
"""Kinds that have no target: they concern all joints of a machine or none."""

_SESSION = 3600.0  # s between recordings, chosen: a machine has cooled down and settled by then


@dataclasses.dataclass
class Subject:
  """A joint under analysis."""

  joint: str
  now: JointLikelihood
  known: tuple[Term, ...]
  """Constants, effects that the reference shows and those of scopes beyond the joint."""
  library: list[Term]
  """Effects that may be the joint's own."""
  freed: Term
  """The constants, wider."""
  explainer: Explainer
  sharing: float
  """Joints over which the level of significance is shared, for each that has a name."""
  alone: bool
  """Whether the machine has no other joint, so that effects of the machine are its own."""
  before: JointLikelihood | None = None
  """Of the reference."""
  usual: Scored | None = None
  """The reference's best hypothesis."""
  paired: bool = False
  """Whether every log was driven by the same commands as a reference."""

  @property
  def thresholds(self) -> tuple[float, ...]:
    """Standard errors that count as clear, of one effect, of a second beside it and so on."""
    kinds = {t.kind for t in self.library} | set(WHOLE)
    return thresholds(len(kinds), self.sharing, self.now.settings)

  @property
  def beyond(self) -> float:
    """Standard errors that count as clear of one effect."""
    return self.thresholds[0]

  @property
  def another_session(self) -> bool:
    """Whether a log was recorded long before or after every reference."""
    return self.before is not None and _apart(self.now, self.before)

  @property
  def left(self) -> float:
    """What the constants alone leave in the median block, over the readings' noise."""
    squares = self.explainer.null.fit.held[0][0]
    return float(np.sqrt(np.median(squares))) / self.now.position_noise

  def take(self, term: Term) -> None:
    """Adds an effect that has been found to hold, fits the constants anew."""
    self.known = (*self.known, term)
    self.explainer = _explainer(self.now, self.before, self.known, self.library, self.freed)

  @property
  def _judged(self) -> list[JointLikelihood]:
    return [self.now] if self.before is None else [self.now, self.before]

  @property
  def state(self) -> tuple[Any, ...]:
    """What is known, the hypotheses that were scored, and the residual's scale."""
    shown = self.now.expectation, _unit(self.now)
    known = self.known, self.freed, self.usual, self.paired, shown
    scored = self.explainer, self.explainer.null, dict(self.explainer.scored)
    scales = [(j.scale, j.observations) for j in self._judged]
    return known, scored, scales

  @state.setter
  def state(self, state: tuple[Any, ...]) -> None:
    known, scored, scales = state
    self.known, self.freed, self.usual, self.paired, shown = known
    self.now.expectation, unit = shown
    if isinstance(self.now.effort, Torques):
      self.now.effort.unit = unit
    for joint, (scale, observations) in zip(self._judged, scales, strict=True):
      joint.scale, joint.observations = scale, observations
    self.explainer, self.explainer.null, kept = scored
    self.explainer.scored = dict(kept)
    self.explainer.rescore()


def prepare(
  joint: str, machine: Machine, reference: Machine | None, *, tried: int, settings: Settings
) -> Subject:
  """Returns a joint with its constants fitted.

  Its courses are compared with those simulated from the commands alone, unless no actuator holds
  its position, so that errors of torque add up, or what they leave of a reference's goes together
  for longer than a block: then with what is predicted from each reading on.

  Args:
    joint: its name.
    machine: the declared model along the logs to explain.
    reference: the same along those of before; None if there are none.
    tried: joints that are looked at, over which the level of significance is shared.
    settings: tolerances and effort.
  """
  now, before = (
    None if m is None else JointLikelihood(m.joint(joint), settings=settings)
    for m in (machine, reference)
  )
  assert now is not None
  library = own_library(now.plant, alone=tried == 1)
  found = _subject(now, before, library, tried, alone=tried == 1)
  apart = not (found.paired or before is None or _tells(before))
  return following(found) if apart or not now.plant.holds else found


def following(subject: Subject) -> Subject:
  """Returns a joint judged by a simulation whose state follows the readings, beside the same
  effects of wider scope; what its reference has is found there anew."""
  now, before = (
    None if j is None else JointLikelihood(j.plant, settings=j.settings, follows=True)
    for j in (subject.now, subject.before)
  )
  assert now is not None
  found = _subject(now, before, subject.library, subject.sharing, alone=subject.alone)
  for term in (t for t in subject.known if t.wider):
    found.take(term)
  if subject.usual is not None and subject.usual.names:
    explain_reference(found, now.settings)
  return found


def _tells(joint: JointLikelihood) -> bool:
  """Tells whether what a course leaves in a block is worth an observation: where a joint that stops
  stays a little off, the residual goes together for longer."""
  return bool(np.median(joint.observations[0]) >= 1.0)


def _subject(
  now: JointLikelihood,
  before: JointLikelihood | None,
  library: list[Term],
  sharing: float,
  *,
  alone: bool,
) -> Subject:
  joint, settings = now.plant.joint, now.settings
  if before is None:
    own = constants(now.plant, settings)
    freed = widened(own)
    explainer = _explainer(now, None, (own,), library, freed)
    return Subject(joint, now, (own,), library, freed, explainer, sharing, alone)
  if isinstance(now.effort, Duties):
    now.effort.ahead = None if before.law is None else _ahead(before.law, settings)
  usual = reference_constants(before, settings)
  known, paired, freed = _shown(now, before, usual)
  explainer = _explainer(now, before, known, library, freed)
  return Subject(
    joint, now, known, library, freed, explainer, sharing, alone, before, usual, paired
  )


def _shown(
  now: JointLikelihood, before: JointLikelihood, usual: Scored
) -> tuple[tuple[Term, ...], bool, Term]:
  """Returns what a reference's hypothesis says of logs: what is known, whether every log has its
  like, and the constants, of which some may have changed."""
  if isinstance(now.effort, Torques):
    now.effort.unit = before.effort_factor(usual.terms, usual.fit.x)
  known = known_terms(usual, now.settings, another_session=_apart(now, before))
  paired = now.expect(before, usual.fit.residuals[0], usual.terms, usual.fit.x)
  return known, paired, freed_constants(known[0])


def _unit(joint: JointLikelihood) -> float | None:
  """Returns the unit of a joint's efforts, None where none is known."""
  return joint.effort.unit if isinstance(joint.effort, Torques) else None


def _apart(now: JointLikelihood, before: JointLikelihood) -> bool:
  """Tells whether one of the logs was recorded long before or after every reference."""
  times, known = (np.array([r.log.start_ns for r in j.plant.reductions]) for j in (now, before))
  return bool(np.abs(times[:, None] - known[None]).min(axis=1).max() > 1e9 * _SESSION)


def _ahead(law: ServoLaw, settings: Settings) -> tuple[float, float]:
  """Returns the interval of what positions are ahead of duties in another recording than the law's:
  by the law's own deviation, and by what readings differ between two recordings."""
  reach = settings.sigmas * float(np.hypot(law.ahead_deviation, dict(settings.repeat)["skew"]))
  return law.ahead - reach, law.ahead + reach


def explain_reference(subject: Subject, settings: Settings) -> None:
  """Finds the effects that a joint has anyway, where its reference leaves what is no noise."""
  before = subject.before
  if before is None or subject.usual is None:
    return
  if not subject.alone and not structured(before, subject.usual, settings):
    return
  own = subject.usual.terms[0]
  library = own_library(before.plant, alone=subject.alone)
  known, x = subject.usual.terms[1:], subject.usual.fit.x
  first = Explainer(before, own, library, settings=settings, known=known, start=x)
  usual = conclude(before, grow(first, settings.reference_depth), subject.thresholds).best
  known, subject.paired, subject.freed = _shown(subject.now, before, usual)
  shared = [t for t in subject.known if t.wider]
  subject.usual, subject.known = usual, (*known, *shared)
  subject.explainer = _explainer(subject.now, before, subject.known, subject.library, subject.freed)


def _explainer(
  now: JointLikelihood,
  before: JointLikelihood | None,
  known: Sequence[Term],
  library: Sequence[Term],
  freed: Term,
) -> Explainer:
  changed = () if before is None else changed_constants(known[0])
  return Explainer(
    now, known[0], library, settings=now.settings, known=known[1:], freed=freed, changed=changed
  )


def own_library(plant: JointModel, *, alone: bool) -> list[Term]:
  """Returns the effects to try; where torque repeats with position is read off the residual."""
  waves = signatures.waves(plant)
  terms = [*candidates.library(plant), candidates.cogging(plant, waves)]
  terms = [t for t in terms if alone or t.kind not in WHOLE]
  return [plausible(term, plant) for term in terms] if plant.hinge else terms
