"""Fits 3D Gaussian splats to pictures that a radiance field renders from a robot's places.

Every picture of the field is used for a few steps only: there is no training set to overfit.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numba
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.export import views
from nerf2real.scenes.export.splats import projection, rasteriser, start
from nerf2real.scenes.export.splats.splats import Splats
from nerf2real.scenes.field.render.renderer import Renderer


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitSettings:
  """Settings of the splats and their fit."""

  max_splats: int = 100_000
  """At most so many; at most 200,000 are sensible in a browser."""
  steps: int = 6000
  """Pictures that are fitted to, one a step."""
  uses: int = 3
  """Steps with a picture of the field, on average; to render one takes as long as a step."""
  seconds: float | None = None
  """The fit ends after this wall time [s] at the latest."""
  seed_views: int = 150
  """Pictures that the splats start from, half from the robot's places, half from the capture's."""
  finest: float = 0.009
  """Least distance of neighbouring splats at the start [m]."""
  eye_height: float = 0.44
  """Of the robot's camera above the floor [m]: a standing OP3's."""
  vertical_fov: float = 0.7557
  """Of the robot's camera [rad]: 43.3 degrees, a Logitech C920 as mounted."""
  size: tuple[int, int] = (60, 80)
  """Height and width of the robot's pictures [pixel]."""
  fine_share: float = 0.2
  """Share of the steps with pictures of twice the size, half of them from the capture's places:
  for eyes that come nearer than the robot."""
  rate: float = 1.0
  """Factor on all learning rates."""
  seed: int = 0
  """Of places and steps."""


# Learning rates of Adam by column of the packed parameters: offsets, logarithms of scales,
# rotations, logits, colours. Chosen: a splat is in the picture in a tenth of the steps or less.
_RATES = np.repeat([0.04, 0.04, 0.03, 0.1, 0.02], [3, 3, 4, 1, 3]).astype(np.float32)
_MOMENTUM, _SQUARES, _EPSILON = 0.9, 0.99, 1e-12  # of Adam (Kingma and Ba 2015)
_FINAL = 0.05  # of the learning rates, at the last step
_AVERAGED = 1 / 3  # share of the fit, at its end, whose mean is taken (Polyak and Juditsky 1992)
_LOWEST_TILT, _HIGHEST_TILT = 0.1, 0.55  # rad downwards: the paper's head tilt and a gait's sway
_KEPT = 64  # pictures that are used again, in any order
_MARGIN = 1.15  # of the field of view within which splats may reach into the picture


class Picture(NamedTuple):
  """What the field looks like."""

  camera: Camera
  world_from_camera: np.ndarray  # [4, 4]
  color: np.ndarray  # [H, W, 3], 0 to 1


def robot_poses(
  bundle: Bundle, count: int, *, eye_height: float, rng: np.random.Generator
) -> np.ndarray:
  """Poses [N, 4, 4] of a robot's camera in the world: anywhere it fits, looking ahead and down."""
  places = bundle.free_space.sample(rng, count)
  tilts = rng.uniform(_LOWEST_TILT, _HIGHEST_TILT, count)
  poses = np.tile(np.eye(4), (count, 1, 1))
  for pose, (x, y, yaw), tilt in zip(poses, places, tilts, strict=True):
    level = np.cos(tilt)
    pose[:3, :3] = camera_axes(np.array([np.cos(yaw) * level, np.sin(yaw) * level, -np.sin(tilt)]))
    pose[:3, 3] = x, y, eye_height
  return poses


class Fit:
  """Parameters of splats and the state of their optimiser, Adam on the splats in the picture."""

  def __init__(self, points: start.Seeds):
    """Starts splats at points."""
    self.points = points
    self.rows = start.rows_of(points)
    self._starts = points.positions.astype(np.float32)
    self._spacing = points.spacing.astype(np.float32)
    self._mean, self._square = np.zeros_like(self.rows), np.zeros_like(self.rows)
    self._seen = np.zeros(len(self.rows), np.float32)  # steps that each splat took part in

  def _draw(self, camera: Camera, eye: projection.Eye):
    """Draws the splats that may be in the picture."""
    positions = self._starts + self._spacing[:, None] * self.rows[:, :3]
    local = positions @ eye.rotation.T + eye.translation
    shown = np.flatnonzero(
      (local[:, 2] > 0)
      & (np.abs(local[:, :2]) < _MARGIN * eye.slope * local[:, 2:] + self._spacing[:, None]).all(-1)
    )
    arguments = (self.rows[shown], self._starts[shown], self._spacing[shown], eye)
    gaussians, bounds = projection.project(*arguments)
    size = {"width": camera.width, "height": camera.height}
    tiles = rasteriser.assign(bounds, **size)
    return shown, arguments, gaussians, rasteriser.composite(tiles, gaussians, **size)

  def render(self, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
    """Renders the splats: float32 [H, W, 3], not clipped."""
    return self._draw(camera, projection.Eye.at(camera, world_from_camera))[-1].image

  def step(
    self,
    camera: Camera,
    world_from_camera: np.ndarray,
    truth: np.ndarray,
    *,
    rate: float = 1.0,
  ) -> float:
    """Takes one step towards a picture.

    Args:
      camera: Of the picture; without distortion.
      world_from_camera: Its pose [4, 4].
      truth: The picture [H, W, 3], 0 to 1.
      rate: Factor on the learning rates.

    Returns:
      The mean squared error before the step.
    """
    eye = projection.Eye.at(camera, world_from_camera)
    shown, arguments, gaussians, drawn = self._draw(camera, eye)
    error = drawn.image - truth.astype(np.float32)
    slopes = rasteriser.composite_backward(gaussians, drawn, (2 / error.size) * error)
    rows, starts, spacing, _ = arguments
    gradient = projection.pull(rows, starts, spacing, eye, projection.Projected(*slopes))
    _descend(self.rows, self._mean, self._square, self._seen, shown, gradient, rate * _RATES)
    return float(np.mean(error**2))

  @property
  def splats(self) -> Splats:
    """The splats as they are now."""
    return start.splats_of(self.rows, self.points)


@numba.njit(cache=True)
def _descend(rows, mean, square, seen, shown, gradient, rates):
  """Takes a step of Adam on the rows that are shown."""
  for k, row in enumerate(shown):
    seen[row] += 1
    first, second = 1 - _MOMENTUM ** seen[row], 1 - _SQUARES ** seen[row]
    for column in range(gradient.shape[1]):
      slope = gradient[k, column]
      mean[row, column] += (1 - _MOMENTUM) * (slope - mean[row, column])
      square[row, column] += (1 - _SQUARES) * (slope * slope - square[row, column])
      size = np.sqrt(square[row, column] / second) + _EPSILON
      rows[row, column] -= rates[column] * mean[row, column] / first / size


def fit(
  bundle: Bundle, *, settings: FitSettings | None = None, progress: Progress = no_progress
) -> Splats:
  """Fits splats to a bundle's field, world frame.

  Args:
    bundle: The scene.
    settings: How.
    progress: Called with the fraction done and a text.
  """
  settings = settings or FitSettings()
  rng = np.random.default_rng(settings.seed)
  renderer = views.renderer_of(bundle)
  height, width = settings.size
  robot = Camera.from_vertical_fov(settings.vertical_fov, width, height)
  filmed, capture, _ = views.capture_cameras(bundle)
  wide = Camera.from_vertical_fov(
    filmed.vertical_fov, round(height * filmed.width / filmed.height), height
  )

  def poses(count: int) -> np.ndarray:
    if not bundle.free_space.reachable.any():  # a thing that was filmed by itself
      return capture[rng.integers(0, len(capture), count)]
    return robot_poses(bundle, count, eye_height=settings.eye_height, rng=rng)

  half = settings.seed_views // 2
  found = [
    views.render_views(bundle, renderer, camera.resized(2 * camera.width, 2 * camera.height), at)
    for camera, at in ((robot, poses(half)), (wide, capture[rng.integers(0, len(capture), half)]))
  ]
  lower, upper = bundle.extent
  far = 2 * float(np.linalg.norm(upper - lower))
  offered = [start.seeds(view, far=far, spacing=2.0) for view in found]
  points = start.Seeds(*(np.concatenate(column) for column in zip(*offered, strict=True)))
  points = start.thin_to(points, count=settings.max_splats, finest=settings.finest)
  fitted = Fit(points)

  def place() -> tuple[Camera, np.ndarray]:
    if rng.random() >= settings.fine_share:
      return robot, poses(1)[0]
    if rng.random() < 0.5:
      return robot.resized(2 * width, 2 * height), poses(1)[0]
    return wide.resized(2 * wide.width, 2 * height), capture[rng.integers(len(capture))]

  _run(fitted, _pictures(bundle, renderer, place, settings.uses, rng), settings, progress)
  return fitted.splats


def _pictures(
  bundle: Bundle,
  renderer: Renderer,
  place: Callable[[], tuple[Camera, np.ndarray]],
  uses: int,
  rng: np.random.Generator,
) -> Iterator[Picture]:
  """Yields pictures of the field from places, each `uses` times on average."""
  unit_from_world = bundle.world_from_unit.inverse()
  kept: list[Picture] = []
  while True:
    if len(kept) < _KEPT or rng.random() < 1 / uses:
      camera, pose = place()
      color = renderer.render(camera, unit_from_world.apply_pose(pose))[0]
      if len(kept) == _KEPT:
        kept.pop(rng.integers(_KEPT))
      kept.append(Picture(camera, pose, color / 255.0))
      yield kept[-1]
    else:
      yield kept[rng.integers(_KEPT)]


def _run(
  fitted: Fit, pictures: Iterator[Picture], settings: FitSettings, progress: Progress
) -> None:
  """Takes the steps; the splats are the mean of those that the last ones left."""
  began, mean = time.monotonic(), 0.0
  average, count = np.zeros_like(fitted.rows), 0
  for step in range(settings.steps):
    camera, pose, truth = next(pictures)
    spent = time.monotonic() - began
    done = max(step / settings.steps, spent / settings.seconds if settings.seconds else 0.0)
    if done >= 1:
      break
    rate = settings.rate * _FINAL**done
    error = fitted.step(camera, pose, truth, rate=rate)
    mean += (error - mean) / min(step + 1, 100)
    if done >= 1 - _AVERAGED:
      count += 1
      average += (fitted.rows - average) / count
    if step % 20 == 0:
      progress(done, f"step {step}, {-10 * np.log10(max(mean, 1e-10)):.1f} dB")
  if count:
    fitted.rows = average
