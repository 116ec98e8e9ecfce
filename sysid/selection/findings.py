"""What an identification found, before it is written down."""

import dataclasses
from typing import Any

import mujoco

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.selection.changes import Changed


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
  in_reference: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of effects that reference logs show, too: the model lacks them, nothing has changed."""

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
