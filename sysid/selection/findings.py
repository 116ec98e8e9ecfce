"""What an identification found, before it is written down."""

import collections
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.simulation import Clocks, Member
from nerf2real.sysid.selection.in_machine import effects_of
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.search.evidence import Scored


class Zero(NamedTuple):
  """A joint's shifted zero that was found over all joints."""

  offset: float = 0.0  # rad
  deviation: float = 0.0  # its standard deviation, rad


def _firsts(drawn: Sequence[Scored]) -> list[int]:
  """Returns where each draw is first among all."""
  ids = [id(item) for item in drawn]
  return [ids.index(one) for one in ids]


@dataclasses.dataclass
class Identified:
  """What an identification found, before it is written down."""

  model: mujoco.MjModel
  logs: list[Log]
  joints: list[Changed]
  """All, those that are explained least first."""
  audits: list[dict[str, Any]]
  verdict: str = "none"
  effects: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of the report that are claimed."""
  nearest: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries that are in the extended model, and not claimed."""
  objects: list[Effect] = dataclasses.field(default_factory=list)
  """Effects of the extended model, claimed or not."""
  calibration: list[Effect] = dataclasses.field(default_factory=list)
  """Declared constants corrected, one effect a joint."""
  clocks: dict[str, Clocks] = dataclasses.field(default_factory=dict)
  zeros: dict[str, Zero] = dataclasses.field(default_factory=dict)
  """Joints' zeros that were found over all joints, beside those found at one."""
  in_reference: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of effects that reference logs show, too: the model lacks them, nothing has changed."""

  scopes: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of alternatives: an effect of several joints at one of them alone."""
  twins: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of alternatives: effects of several joints that predict the same as a claimed one."""
  still: list[str] = dataclasses.field(default_factory=list)
  """Joints that are commanded and do not move in the logs, or not in the reference."""

  @property
  def near(self) -> list[Member]:
    """What to simulate with: the extended model, and others with other draws from the fits of
    joints that have several, each weighed by how often it is drawn."""
    count = max((len(j.near) for j in self.joints), default=1)
    places = [_firsts(j.near) for j in self.joints]
    drawn = [tuple(row[k % len(row)] for row in places) for k in range(count)]
    own = Member([*self.calibration, *self.objects], self.clocks)
    return [
      self._member(own, which)._replace(weight=often)
      for which, often in collections.Counter(drawn).items()
    ]

  def _member(self, own: Member, which: Sequence[int]) -> Member:
    """Returns the extended model with other fits at joints that have several.

    Args:
      own: the extended model.
      which: the place of each joint's fit among its draws, 0 for its own.
    """
    effects, clocks = list(own.effects), dict(own.clocks)
    for item, at in zip(self.joints, which, strict=True):
      if not at:
        continue
      theirs = {(e.kind, e.target) for e in effects_of(item.joint, item.near[0])[0]}
      theirs.add(("encoder_offset", item.joint))
      effects = [e for e in effects if (e.kind, e.target) not in theirs]
      zero = self.zeros.get(item.joint, Zero())
      other, clocks[item.joint] = effects_of(item.joint, item.near[at], offset=zero.offset)
      effects += other
    return Member(effects, clocks)

  @property
  def found(self) -> list[Changed]:
    """The joints that have anything, at least one."""
    return [j for j in self.joints if j.verdict != "none"] or self.joints[:1]

  @property
  def unexplained(self) -> list[Changed]:
    """The joints that are not explained to the end."""
    return [j for j in self.joints if j.verdict in ("partly", "unexplained")]

  @property
  def followed(self) -> list[Changed]:
    """The joints that were judged by a simulation whose state follows the readings."""
    return [j for j in self.joints if j.likelihood.follows]

  @property
  def least_explained(self) -> Changed:
    """The joint that is not explained to the end and leaves most, else the first."""
    return max(
      self.unexplained, key=lambda j: j.left / max(j.reference_left, 1e-12), default=self.joints[0]
    )
