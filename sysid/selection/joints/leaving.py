"""What a joint leaves under a hypothesis, against what the machine leaves anyway."""

import numpy as np

from nerf2real.sysid.fit.expectation import NOISE
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.selection.joints import play
from nerf2real.sysid.selection.joints.baseline import differs
from nerf2real.sysid.selection.joints.remainder import (
  grown,
  mean_left,
  repeats,
  scatter,
  structured,
)
from nerf2real.sysid.selection.joints.subject import Subject
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.settings import Settings

Array = np.ndarray


def leaves(subject: Subject, item: Scored, settings: Settings) -> bool:
  """Tells whether a hypothesis leaves more than the machine does anyway.

  Beside a reference with the same commands only noise may remain, and what a machine's constants
  differ by within a recording; beside another its blocks are the measure; without one, a multiple
  of the readings' noise.
  """
  if subject.paired:
    moved, beside = _moved(subject), play.beside(subject.now, item)
    return structured(subject.now, item, settings, moved, beside)
  if subject.usual is not None:
    return grown(item, subject.usual, subject.beyond, settings)
  left, noise = np.median(item.fit.held[0][0]), np.median(subject.now.noise_squares)
  return bool(left > settings.more**2 * noise)


def may_leave(subject: Subject, item: Scored, settings: Settings) -> bool:
  """Tells whether a hypothesis may leave more than the machine does anyway: effects are tried then,
  and names must be clear by themselves. What constants take to be off by more than they are
  between recordings, or copies, they may take from an effect."""
  if item.is_strained(settings.level):
    return True
  if subject.usual is not None and not subject.paired:
    return grown(item, subject.usual, settings.suspected, settings)
  return leaves(subject, item, settings)


def is_unusual(subject: Subject, item: Scored, settings: Settings) -> bool:
  """Tells whether a hypothesis leaves more than a healthy machine does.

  Without references that is noise and what constants move that differ within a recording. A name
  does not stand for that: where there is one noise alone is the measure.
  """
  anyway, left = remaining(subject, item, healthy=True)
  more = bool(np.any(settings.more**2 * anyway < left))
  return more or (subject.before is not None and leaves(subject, item, settings))


def _moved(subject: Subject) -> Array:
  """Returns the mean squares of blocks [B] by which a machine's constants move its course, as far
  as they differ within a recording: what one value for all of it explains was fitted before, also
  where constants are those of another session."""
  now, null, own = subject.now, subject.explainer.null, subject.known[0]
  layout = null.fit.layout  # its constants come first, which may be freed
  differ = np.array(differs(dict(zip(own.names, own.centre, strict=True)), now.settings, False))
  differ[[name not in now.settings.wandering for name in own.names]] = np.inf
  sigma = np.full_like(layout.sigma, np.inf)
  sigma[slice(*layout.spans[0])] = differ
  return repeats(now, null, sigma)


def remaining(subject: Subject, item: Scored, *, healthy: bool = False) -> tuple[Array, Array]:
  """Returns what a machine leaves anyway, and what a hypothesis does: mean squares [2] of
  the median block, and of all blocks by `mean_left`; of a healthy machine also without references
  with what its constants differ by within a recording."""
  now, before, usual = subject.now, subject.before, subject.usual

  def both(joint: JointLikelihood, squares: Array) -> Array:
    return np.array([np.median(squares), mean_left(joint, squares)])

  readings = now.noise_squares * (1.0 + NOISE if subject.paired else 1.0)
  if subject.paired or healthy:
    readings = readings + _moved(subject)
  if subject.paired:
    readings = readings + play.beside(now, item)
  anyway = np.array([np.median(readings), readings.mean()])
  if before is not None and usual is not None and not subject.paired:
    anyway = both(before, usual.fit.held[0][0])
  if now.follows:
    anyway = np.maximum(anyway, both(now, scatter(now, item)))
  return anyway, both(now, item.fit.held[0][0])
