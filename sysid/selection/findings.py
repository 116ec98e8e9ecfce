"""What an identification found, before it is written down."""

import dataclasses
from typing import Any

import mujoco

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.selection.joint import Found
from nerf2real.sysid.selection.screening import Screened


@dataclasses.dataclass
class Identified:
  """What an identification found, before it is written down."""

  model: mujoco.MjModel
  logs: list[Log]
  screened: list[Screened]
  found: list[Found]
  audits: list[dict[str, Any]]
  verdict: str = "none"
  effects: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of the report that are claimed."""
  nearest: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of joints that stay unexplained: in the extended model, not claimed."""
  objects: list[Effect] = dataclasses.field(default_factory=list)
  """The same as effects that can be simulated."""
  calibration: list[Effect] = dataclasses.field(default_factory=list)
  """Declared constants corrected, one effect a joint."""
  clocks: dict[str, Clocks] = dataclasses.field(default_factory=dict)
  learned: list[Effect] = dataclasses.field(default_factory=list)
  in_reference: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of effects that reference logs show, too: the model lacks them, nothing has changed."""

  @property
  def unexplained(self) -> list[Found]:
    """The joints that stay unexplained, the one that leaves most first."""
    items = [f for f in self.found if f.finding.verdict == "unexplained"]
    return sorted(items, key=lambda f: -f.screened.excess)

  @property
  def followed(self) -> list[Found]:
    """The joints with named effects that were judged by a simulation that follows the readings."""
    return [f for f in self.found if f.finding.named and f.ladder.problem.plant.follows]

  @property
  def least_explained(self) -> Found:
    """The joint that stays unexplained and leaves most, else the one that was raced first."""
    return (self.unexplained or self.found)[0]
