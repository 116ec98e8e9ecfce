"""What is new at a joint: what was tried, what is named, what remains."""

import dataclasses

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.joints.naming import Explanation
from nerf2real.sysid.selection.joints.subject import Subject
from nerf2real.sysid.selection.search.evidence import Scored, more_likely

Array = np.ndarray
CONSTANTS_OFF = "parameter_error"


@dataclasses.dataclass
class Changed:
  """What is new at a joint."""

  subject: Subject
  ranked: list[Scored]
  found: Explanation
  named: tuple[str, ...]
  """Kinds that are certain, and absent from the reference."""
  verdict: str
  """none, effects, partly or unexplained."""
  reference_left: float
  """What the machine leaves anyway, root of `mean_left`, rad (m)."""
  left: float
  """The same of the logs, under the best hypothesis."""
  more_remains: bool
  """Whether that is more than the machine leaves anyway, by the limit of what counts as more."""
  constants_off: bool
  """Whether declared constants are off by more than machines of one kind differ."""
  growing: tuple[str, ...] = ()
  """Kinds that would be certain, and are not the same at a log's begin and end."""
  elaborated: list[Scored] = dataclasses.field(default_factory=list)
  """Draws from fits with richer friction, the likeliest first."""

  @property
  def extended(self) -> Scored:
    """The hypothesis to simulate with: where more remains, the one of fewest effects that is not
    less likely by one over the level, even without the block that says so most.
    Names ask for more, as they are to hold of other motions. What a needless effect imitates here
    it does elsewhere, too: a zero that is shifted in the air tilts a robot on its feet."""
    if self.verdict not in ("partly", "unexplained"):
      return self.found.best
    if self.elaborated:
      return self.elaborated[0]
    fitting = [s for s in self.ranked if not s.neutral and s.names >= set(self.named)]
    if not fitting:
      return self.found.best
    top = max(fitting, key=lambda s: s.evidence)
    level = self.likelihood.settings.level
    near = [s for s in fitting if not more_likely(top.nats - s.nats, top.prior - s.prior, level)]
    return min(near, key=lambda s: (len(s.names) + s.beside_force, -s.evidence))

  @property
  def near(self) -> list[Scored]:
    """The hypotheses whose mean is predicted with: draws from fits, the best of them first."""
    best = self.extended
    return self.elaborated if any(best is s for s in self.elaborated) else [best]

  @property
  def likelihood(self) -> JointLikelihood:
    """The logs."""
    return self.subject.now

  @property
  def declared(self) -> Scored:
    """The model as it is declared."""
    return self.subject.explainer.declared

  @property
  def alternatives(self) -> list[Scored]:
    """The best hypothesis of every other set of effects, the best first."""
    best: dict[frozenset[str], Scored] = {}
    for item in self.ranked:
      if item.names and not item.neutral and not item.beside_force:
        best.setdefault(item.names, item)
    best.pop(self.extended.names, None)
    return list(best.values())

  @property
  def confounded(self) -> list[Scored]:
    """The smallest hypotheses without a named effect that predict the same."""
    alike: dict[int, Scored] = {}
    for name in self.found.names:
      twins = [s for s in name.confounded if s.names and name.kind in self.named]
      least = min((len(s.names) for s in twins), default=0)
      alike |= {id(s): s for s in twins if len(s.names) == least}
    return list(alike.values())

  @property
  def joint(self) -> str:
    """Its name."""
    return self.subject.joint

  @property
  def known(self) -> tuple[Term, ...]:
    """Constants and effects that were known before."""
    return self.subject.known

  @property
  def null(self) -> Scored:
    """The baseline."""
    return self.subject.explainer.null
