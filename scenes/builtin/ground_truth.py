"""Measures a reconstruction of a known room, the built-in one by default, against its truth.

The truth's frame and the reconstruction's world differ by a turn about the vertical and a shift,
which nothing but a marker's place fixes; they are taken from the camera positions, and told. Scale
is not: its error counts.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import camera_axes, yaw_of
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import to_plain
from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.builtin import filming, furniture, room
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.geometry import convex
from nerf2real.scenes.quality import collision_error, image_quality, sight_lines
from nerf2real.scenes.quality import held_out as evaluate
from nerf2real.scenes.stages.results import Reconstruction, TruthFigures

VIDEO = filming.SHIPPED_VIDEO
TRUTH = VIDEO.with_name("room_truth.json")
ROBOT_VIEWS = VIDEO.with_name("robot_views.npz")
MARKER_SIDE = furniture.MARKER_SIZE
MARKER_AT = MarkerPlace(*furniture.MARKER_CENTRE, float(np.degrees(furniture.MARKER_YAW)))

_EYE_HEIGHT = 0.44  # of the standing OP3's camera [m]; facts of its links
_VERTICAL_FOV = np.radians(43.3)  # Logitech C920 as mounted; public OP3 descriptions
_ROBOT_VIEWS = 24
_CLEARANCE = 0.35  # of a robot view from everything [m]
_SURFACE_POINTS = 60_000

Pictures = Mapping[str, np.ndarray]
"""Poses of a robot's camera `world_from_camera` [N, 4, 4], and for every size what it truly sees,
`images_HxW` uint8 [N, H, W, 3]."""


def robot_camera(height: int, width: int) -> Camera:
  """The OP3's camera at a picture size."""
  return Camera.from_vertical_fov(_VERTICAL_FOV, width, height)


def robot_poses(
  count: int = _ROBOT_VIEWS, *, seed: int = 0, true_room: room.TrueRoom | None = None
) -> np.ndarray:
  """Poses [N, 4, 4] of the robot's camera, uniform over the open floor, looking ahead and down.

  Args:
    count: Number of poses N.
    seed: Of the poses, and of the built-in room.
    true_room: Which room; the built-in one for None.
  """
  rng = np.random.default_rng([seed, 7])
  true_room = true_room or room.builtin(seed)
  half = np.array(true_room.size[:2]) / 2
  poses: list[np.ndarray] = []
  while len(poses) < count:
    position = np.array([*rng.uniform(-half, half), _EYE_HEIGHT])
    if true_room.distance(position[None])[0] < _CLEARANCE:
      continue
    yaw, tilt = (
      rng.uniform(-np.pi, np.pi),
      rng.uniform(0.16, 0.5),
    )  # the paper's head tilt, downwards
    forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
    pose = np.eye(4)
    pose[:3, :3] = camera_axes(forward)
    pose[:3, 3] = position
    poses.append(pose)
  return np.stack(poses)


def robot_views(poses: np.ndarray, eye: Eye) -> dict[str, np.ndarray]:
  """Returns what the robot's camera truly sees from poses [N, 4, 4], at the policies' sizes."""
  arrays: dict[str, np.ndarray] = {"world_from_camera": poses}
  for height, width in evaluate.ROBOT_SIZES:
    camera = robot_camera(height, width)
    pictures = [room.true_view(camera, pose, eye=eye)[0] for pose in poses]
    arrays[f"images_{height}x{width}"] = np.stack(pictures)
  return arrays


def write_robot_views(path: Path, *, seed: int = 0) -> None:
  """Films what the robot's camera truly sees of the built-in room (needs EGL)."""
  poses = robot_poses(seed=seed)
  with room.room_eye(seed) as eye:
    arrays = robot_views(poses, eye)
  with files.atomic_path(path) as partial:
    np.savez_compressed(partial, **arrays)  # type: ignore[arg-type]


def measure(result: Reconstruction) -> TruthFigures:
  """Measures a reconstruction from the shipped film against the truth."""
  truth = filming.read_truth(TRUTH)
  frames = np.round(np.asarray(result.frame_times) * truth["frame_rate"]).astype(int)
  true_poses = truth["world_from_camera"][np.clip(frames, 0, len(truth["world_from_camera"]) - 1)]
  return compare(result, true_poses)


def compare(
  result: Reconstruction,
  true_poses: np.ndarray,
  *,
  true_room: room.TrueRoom | None = None,
  pictures: Pictures | None = None,
) -> TruthFigures:
  """Measures poses, scale, floor, robot views and contact geometry against the truth.

  Args:
    result: A reconstruction of a room.
    true_poses: Where its localised keyframes were taken [N, 4, 4], the room's frame.
    true_room: Which room; the built-in one for None.
    pictures: What the robot's camera truly sees of it; the shipped ones for None.
  """
  true_room = true_room or room.builtin()
  pictures = np.load(ROBOT_VIEWS) if pictures is None else pictures
  world = result.alignment.world_from_unit.apply_pose(result.localisation.world_from_camera)
  found, true = world[:, :3, 3], true_poses[:, :3, 3]
  # Poses may differ by any similarity, everything else is metric. Most poses tell where: a few that
  # are before the wrong one of two things alike would turn all that is right.
  free = Similarity.fit_most(found, true)
  rigid = Similarity.fit_most(found, true, with_scale=False)
  turned = free.rotation @ world[:, :3, :3]
  # rotation angle from the trace: 1 + 2 cos(angle)
  cosine = (np.einsum("nij,nij->n", turned, true_poses[:, :3, :3]) - 1) / 2
  angles = np.arccos(np.clip(cosine, -1, 1))
  figures = {
    "camera_rmse_m": float(np.sqrt(np.mean(np.sum((free.apply(found) - true) ** 2, -1)))),
    "camera_rotation_deg": float(np.degrees(np.sqrt(np.mean(angles**2)))),
    "scale_error": float(abs(1 / free.scale - 1)),
    "floor_tilt_deg": float(np.degrees(np.arccos(np.clip(free.rotation[2, 2], -1, 1)))),
    "floor_height_error_m": float(abs(rigid.translation[2])),
    "map_shift_m": float(np.hypot(*rigid.translation[:2])),
    "map_turn_deg": float(np.degrees(abs(yaw_of(rigid.rotation)))),
  }
  views: list[evaluate.ViewScore] = []
  to_unit = result.alignment.world_from_unit.inverse() @ rigid.inverse()
  for height, width in evaluate.ROBOT_SIZES:
    scores = _robot_scores(result, to_unit, pictures, height, width)
    size = "" if (height, width) == evaluate.ROBOT_SIZES[0] else f"_{height}x{width}"
    figures[f"robot_psnr{size}_db"] = float(np.mean([score.psnr_db for score in scores]))
    views = views or scores
  figures |= _contact_figures(result, rigid, true_room)
  figures |= _judge_figures(result, rigid, true_room)
  # Where the truth's frame lies: benchmarks compare other pictures of the bundle with the truth.
  return TruthFigures({**figures, "room_from_world": to_plain(rigid)}, views)


def _robot_scores(
  result: Reconstruction, to_unit: Similarity, arrays: Pictures, height: int, width: int
) -> list[evaluate.ViewScore]:
  camera = robot_camera(height, width)
  scores = []
  for number, (pose, true) in enumerate(
    zip(arrays["world_from_camera"], arrays[f"images_{height}x{width}"], strict=True)
  ):
    image, depth = result.renderer.render(camera, to_unit.apply_pose(pose))
    scores.append(
      evaluate.ViewScore(
        f"robot view {number}",
        true,
        image,
        depth,
        image_quality.psnr(image, true),
        image_quality.ssim(image, true),
      )
    )
  return scores


def moved(parts: Sequence[convex.Part], transform: Similarity) -> list[convex.Part]:
  """Returns convex parts in another frame of the same scale."""
  found = []
  for part in parts:
    vertices = transform.apply(part.vertices)
    planes = part.planes.copy()
    planes[:, :3] = part.planes[:, :3] @ transform.rotation.T
    planes[:, 3] = part.planes[:, 3] - planes[:, :3] @ transform.translation
    found.append(part._replace(vertices=vertices, planes=planes))
  return found


def _box(result: Reconstruction, true_room: room.TrueRoom) -> tuple[np.ndarray, np.ndarray]:
  """Lower and upper corner [3] of where contact geometry is judged, in the truth's frame."""
  half = np.array(true_room.size[:2]) / 2 + 0.1
  return np.array([*-half, 0.0]), np.array([*half, result.collision_top])


def _judge_figures(
  result: Reconstruction, rigid: Similarity, true_room: room.TrueRoom
) -> dict[str, float]:
  """Faults that the judge by sight lines finds in the true surfaces: all of them are its own."""
  lower, upper = _box(result, true_room)
  lines = sight_lines.sight_lines(
    result.localisation,
    result.held_out,
    rigid @ result.alignment.world_from_unit,
    lower=lower,
    upper=upper,
  )
  if not len(lines.eyes):
    return {}
  judged = sight_lines.judge_truth(lines, lambda points: np.abs(true_room.distance(points)))
  return {
    "sight_lines_blocked_by_truth": judged.blocked,
    "sight_lines_blocked_by_truth_p95_m": judged.blocked_p95,
    "points_missed_by_truth": judged.missed,
  }


def _contact_figures(
  result: Reconstruction, rigid: Similarity, true_room: room.TrueRoom
) -> dict[str, float]:
  """Distances between the convex parts and the true surfaces, in the truth's frame."""
  lower, upper = _box(result, true_room)
  error = collision_error.collision_error(
    moved(result.parts, rigid),
    true_room.surface(_SURFACE_POINTS)[0],
    eyes=rigid.apply(result.depth.positions),
    lower=lower,
    upper=upper,
    floor_threshold=result.alignment.floor_threshold,
    distance_to_surface=lambda points: np.abs(true_room.distance(points)),
  )
  return {
    "collision_true_p95_m": error.parts_to_surface_p95,
    "collision_true_within_5cm": error.parts_within_5cm,
    "surface_true_p95_m": error.surface_to_parts_p95,
    "surface_true_within_5cm": error.surface_within_5cm,
  }
