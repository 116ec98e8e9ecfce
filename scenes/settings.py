"""Settings of the whole job from a capture to a scene bundle, and their presets."""

import dataclasses

from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.alignment.world_frame import AlignSettings
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.field import settings as training
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.geometry.collision import CollisionSettings
from nerf2real.scenes.geometry.decomposition import ConvexSettings
from nerf2real.scenes.geometry.floor_plan import FreeSpaceSettings
from nerf2real.scenes.geometry.mesh import MeshSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.stereo.dense import StereoSettings

MARKER_SIDES = (0.01, 2.0)  # m: from a coin's size to a poster's
CAMERA_HEIGHTS = (0.05, 10.0)  # m: from a crawling robot's to a tripod's on a gallery


def check_length(what: str, found: float | None, limits: tuple[float, float]) -> None:
  """Raises ValueError for a length outside its limits [m]: another unit was meant."""
  if found is not None and not limits[0] <= found <= limits[1]:
    raise ValueError(
      f"{what} is in metres: found {found:g}, expected {limits[0]:g} to {limits[1]:g}, such as "
      f"{found / 100:g} for {found:g} centimetres."
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSettings:
  """Settings of the whole job; each part is a stage's own settings."""

  capture: CaptureSettings = CaptureSettings()
  """Keyframes."""
  localise: LocaliseSettings = LocaliseSettings()
  """Poses."""
  stereo: StereoSettings = StereoSettings()
  """Points that stereo finds, for the training."""
  train: TrainSettings = TrainSettings()
  """Radiance field."""
  train_width: int = 1280
  """Wider pictures are reduced to this width for training [pixel], for memory."""
  held_out_every: int = 8
  """Every so many keyframes one is kept from training. Mip-NeRF 360's convention."""
  depth_width: int = 320
  """Width of the depth pictures that geometry is made from [pixel]. Chosen: 640 gives 0.6 % more of
  the built-in room's surface, and takes half of the free floor of a living room."""
  align: AlignSettings = AlignSettings()
  """World frame."""
  marker_side: float | None = None
  """Side of the black square of ArUco or AprilTag markers in the room [m]; None: no marker."""
  mesh: MeshSettings = MeshSettings()
  """Surface mesh."""
  collision: CollisionSettings = CollisionSettings()
  """Contact geometry."""
  free_space: FreeSpaceSettings = FreeSpaceSettings()
  """Map of the free floor."""
  baseline: str = "none"
  """"colmap" adds the Poisson mesh of the COLMAP points to the report, as the paper compares."""

  def __post_init__(self):
    check_length("The marker's side", self.marker_side, MARKER_SIDES)
    check_length("The cameras' height", self.align.camera_height, CAMERA_HEIGHTS)
    if self.align.marker_at is not None and self.marker_side is None:
      raise ValueError("A marker's place needs its side: give --marker-side, too.")
    if self.baseline not in ("none", "colmap"):
      raise ValueError(f"Unknown baseline {self.baseline!r}; expected 'none' or 'colmap'.")


def with_marker(settings: SceneSettings, place: MarkerPlace) -> SceneSettings:
  """Returns settings whose world frame has its origin and axes from a marker."""
  return dataclasses.replace(settings, align=dataclasses.replace(settings.align, marker_at=place))


def with_steps(settings: SceneSettings, steps: int | None) -> SceneSettings:
  """Returns settings whose training ends after so many steps, however long they take; for None
  those that were given."""
  if steps is None:
    return settings
  training = dataclasses.replace(settings.train, max_steps=steps, max_seconds=None)
  return dataclasses.replace(settings, train=training)


NO_STEREO = StereoSettings(most_pictures=0)
# of a first look, whose surfaces are rough anyway: in half the time
ROUGH_PARTS = CollisionSettings(parts=ConvexSettings(tolerance=0.025))
ONE_ATTEMPT = LocaliseSettings(attempts=1)
PRESETS = ("fast", "quality", "demo", "tiny", "paper")


def preset(name: str) -> SceneSettings:
  """Returns settings.

  Args:
    name: "fast" for two CPU cores, "quality" with an hour of training, "demo" and "tiny" quicker,
      "paper" the paper's tables.
  """
  if name in ("fast", "quality"):
    return SceneSettings(capture=CaptureSettings(most_keyframes=300), train=training.preset(name))
  if name == "demo":
    return SceneSettings(
      capture=CaptureSettings(num_keyframes=110),
      localise=ONE_ATTEMPT,
      stereo=NO_STEREO,
      train=dataclasses.replace(training.preset("fast"), max_seconds=80.0),
      collision=ROUGH_PARTS,
      baseline="colmap",
    )
  if name == "tiny":
    return SceneSettings(
      capture=CaptureSettings(num_keyframes=60),
      localise=ONE_ATTEMPT,
      stereo=NO_STEREO,
      # a rate for few steps, see benchmarks/results/records/rooms/field_ablation.json
      train=dataclasses.replace(training.preset("fast"), max_seconds=60.0, learning_rate=5e-3),
      collision=ROUGH_PARTS,
    )
  if name == "paper":
    return SceneSettings(
      capture=CaptureSettings(num_keyframes=1000),
      stereo=NO_STEREO,
      train=training.preset("paper"),
      train_width=1920,
    )
  raise ValueError(f"Unknown preset {name!r}; expected one of {', '.join(PRESETS)}.")
