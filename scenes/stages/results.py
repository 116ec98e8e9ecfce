"""Types of the stages' results."""

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from nerf2real.core import files
from nerf2real.scenes.alignment import overrides
from nerf2real.scenes.alignment.world_frame import Alignment
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.training import Snapshot
from nerf2real.scenes.geometry.convex import Part
from nerf2real.scenes.geometry.fusion import DepthViews
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.quality.collision_error import CollisionError
from nerf2real.scenes.quality.held_out import ViewScore
from nerf2real.scenes.quality.sight_lines import Judgement
from nerf2real.scenes.stages.cache import Made, StageResult
from nerf2real.scenes.stages.pictures import PosedPictures


class Source(NamedTuple):
  """The capture that a scene is made from."""

  path: Path
  sha256: str


class Given(NamedTuple):
  """What a person gave for the world frame."""

  override: overrides.Overrides
  override_key: str  # hash of the file of overrides
  marker_side: float | None  # of the black square of a marker in the room [m]

  @classmethod
  def read(cls, override: Path | None, marker_side: float | None) -> "Given":
    """Reads a file of overrides, if there is one.

    Raises:
      ValueError: It cannot be read; the message is one line.
    """
    if override is None:
      return cls(overrides.Overrides(), "", marker_side)
    return cls(overrides.read(override), files.hash_path(override), marker_side)


class Watcher(Protocol):
  """Is shown what is made while it is made."""

  def keyframes(self, capture: Capture) -> None:
    """The keyframes are chosen."""

  def poses(self, found: Localisation) -> None:
    """The keyframes are localised."""

  def field(self, snapshot: Snapshot) -> None:
    """The field has learned more; called in the training's thread, which waits."""


@dataclasses.dataclass(frozen=True)
class TrainedField:
  """The radiance field on disk."""

  path: Path

  @functools.cached_property
  def renderer(self) -> Renderer:
    """The field, loaded and ready to render."""
    return Renderer(Field.load(self.path), threads=os.cpu_count() or 1)


class FreeFloor(NamedTuple):
  """Figures of the free floor."""

  goals: np.ndarray  # [G, 2] m
  area_m2: float


class Contact(NamedTuple):
  """Contact geometry; the files of its parts and of the map lie in the stage's folder."""

  parts: list[Part]
  floor: FreeFloor


class ContactErrors(NamedTuple):
  """Errors of the convex parts."""

  distances: CollisionError  # from the surface that they were made of
  judgement: Judgement | None  # by sight lines; None where points have no pictures


class Moved(NamedTuple):
  """Shares of the depth's pixels whose surface was moved."""

  to_floor: float
  to_planes: float


class SceneResults(NamedTuple):
  """All that a bundle is assembled from."""

  source: Source
  capture: Made[Capture]
  poses: Made[Localisation]
  pictures: PosedPictures
  field: Made[TrainedField]
  figures: Made[dict[str, float]]
  world: Made[Alignment]
  depth: DepthViews  # in the world frame
  moved: Moved
  surface: StageResult
  contact: Made[Contact]
  errors: Made[ContactErrors]
  baseline: Made[dict[str, float]] | None


class Reconstruction(NamedTuple):
  """A reconstructed scene, for measurements against a truth."""

  localisation: Localisation
  renderer: Renderer
  alignment: Alignment
  parts: list[Part]
  depth: DepthViews  # in the world frame
  frame_times: np.ndarray  # of the registered keyframes in the video [N] [s]
  collision_top: float  # height up to which contact geometry is made [m]
  held_out: np.ndarray  # keyframes that trained nothing, bool [N]


class TruthFigures(NamedTuple):
  """Figures against a known truth."""

  figures: Mapping[str, Any]
  robot_views: list[ViewScore]


Measure = Callable[[Reconstruction], TruthFigures]
