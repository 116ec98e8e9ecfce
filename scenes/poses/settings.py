"""Settings of structure from motion."""

import dataclasses

from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.matching.pairs import PairSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocaliseSettings:
  """Settings of structure from motion."""

  features: FeatureSettings = dataclasses.field(default_factory=FeatureSettings)
  pairs: PairSettings = dataclasses.field(default_factory=PairSettings)
  mapper: str = "auto"
  """"global", "incremental", or "auto": incremental, and global where that leaves too many
  keyframes out."""
  attempts: int = 3
  """Of the mapper at most, of which for photographs the one is taken that lacks least of what it
  ought to see, for a film the one that leaps least."""
  attempted: int = 300
  """More keyframes are mapped once: of a thousand that takes a quarter of an hour."""
  max_apart: float = 0.05
  """Of the room's width by which a picture's places in two attempts may differ for these to be the
  same; where none is the same as the best a warning is given. Chosen: the nearest two of five
  attempts at a living room, whose parts hang together by little, were 0.055 apart, the others 0.13
  and more."""
  repair_below: float = 0.95
  """Fraction of registered keyframes under which more pairs are matched."""
  min_fraction: float = 0.5
  """Fewer registered keyframes are an error."""
  min_registered: int = 8
  """Fewer are an error, unless there are few keyframes, see `few_fraction`; a capture's least."""
  few_fraction: float = 0.75
  """Of few keyframes so many are enough. Chosen: one or two of ten photographs often fail."""
  min_parallax: float = 0.08
  """Share of matches that no turn of the camera explains below which a warning is given."""
  refine_known: bool = True
  """Whether poses that came with measured depth are adjusted to the pictures."""
  seed: int = 0
  """Of RANSAC and of the mappers."""
