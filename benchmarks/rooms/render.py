"""Times the field's renderer beside MuJoCo's own.

All of them draw the same views of the built-in room, taking turns on one core, and are compared
with the true picture (each pixel the mean over its area). MuJoCo draws the true geometry with the
true textures: what it lacks in PSNR is aliasing, what the field lacks is reconstruction.

  python benchmarks/rooms/render.py                       # the scene that is shipped
  python benchmarks/rooms/render.py --bundle out/demo     # a bundle of the built-in room
  python benchmarks/rooms/render.py --field F --room-from-unit S.json
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import harness

harness.one_thread()

import mujoco
import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain, read_json
from nerf2real.scenes import bundle
from nerf2real.scenes.builtin import furniture, room
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render import renderer as render
from nerf2real.scenes.quality.image_quality import psnr

SIZES = ((30, 40), (60, 80))  # picture sizes [H, W] of the policies
FIELD_OF_VIEW = np.deg2rad(43.3)  # vertical, Logitech C920
EYE_HEIGHT = 0.44  # of the robot's camera [m]
LOOK_DOWN = 0.3  # [rad]
WALL_DISTANCE = 0.2  # from the border of the free area [m]
POSE_SEED = 7
PAPER_MS = 6.0  # NeRF2Real, section NeRF training: a frame on a V100

Draw = Callable[[int], np.ndarray]  # number of the view -> uint8 [H, W, 3]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the benchmark."""

  bundle: Path | None = None
  """A bundle of the built-in room; the shipped one if neither this nor a field is given."""
  field: Path | None = None
  """A field file instead of a bundle."""
  room_from_unit: Path | None = None
  """With a field: the similarity (JSON) of its frame to the room's; a bundle holds its own."""
  views: int = 40
  """Views that are drawn."""
  repeats: int = 3
  """Times that each view is drawn."""
  core: int = 0
  """The processor core that everything runs on."""


def load_field(settings: Settings) -> tuple[Field, Similarity]:
  """Returns the field and the similarity from its frame to the room's."""
  if settings.field is not None:
    if settings.room_from_unit is None:
      raise SystemExit("--field needs --room-from-unit: where the field lies in the room.")
    return Field.load(settings.field), read_json(settings.room_from_unit, Similarity)
  scene = bundle.Bundle.load(settings.bundle)
  placed = scene.figures.get("room_from_world")
  if placed is None:
    raise SystemExit(
      f"{scene.folder} has no figure room_from_world: it is no bundle of the built-in room, whose "
      "true pictures this benchmark compares with."
    )
  return Field.load(scene.field_path), from_plain(placed, Similarity) @ scene.world_from_unit


def robot_poses(count: int, *, seed: int = POSE_SEED) -> np.ndarray:
  """Draws poses [N, 4, 4] of the robot's camera in the room."""
  random = np.random.default_rng(seed)
  lower, upper = (np.array(corner) for corner in furniture.FREE_AREA)
  poses = np.tile(np.eye(4), (count, 1, 1))
  for pose in poses:
    yaw, tilt = random.uniform(0, 2 * np.pi), LOOK_DOWN + random.normal(0, 0.05)
    forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
    pose[:3, :3] = rotations.camera_axes(forward)
    pose[:2, 3] = random.uniform(lower + WALL_DISTANCE, upper - WALL_DISTANCE)
    pose[2, 3] = EYE_HEIGHT
  return poses


class MujocoDrawer:
  """MuJoCo's renderer with a camera that can be put anywhere."""

  def __init__(self, camera: Camera, poses: np.ndarray, *, fast: bool):
    """Compiles the room; fast: without shadows, reflections and multisampling."""
    spec = room.build_room()
    quality, standard = spec.visual.quality, mujoco.MjSpec().visual.quality
    quality.shadowsize = 0 if fast else standard.shadowsize
    quality.offsamples = 0 if fast else standard.offsamples
    body = spec.worldbody.add_body(name="eye", mocap=True)
    body.add_camera(name="eye", fovy=np.rad2deg(camera.vertical_fov))
    self._model = spec.compile()
    self._data = mujoco.MjData(self._model)
    self._renderer = mujoco.Renderer(self._model, height=camera.height, width=camera.width)
    if fast:
      for flag in ("SHADOW", "REFLECTION", "SKYBOX", "HAZE", "FOG"):
        self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
    self._places = []
    for pose in poses:
      rotation = pose[:3, :3] @ rotations.OPENGL_FROM_OPENCV
      quaternion = rotations.quaternion_from_matrix(rotation)
      self._places.append((pose[:3, 3], quaternion))

  def draw(self, view: int) -> np.ndarray:
    """Renders a view: uint8 [H, W, 3]."""
    self._data.mocap_pos[0], self._data.mocap_quat[0] = self._places[view]
    mujoco.mj_kinematics(self._model, self._data)
    mujoco.mj_camlight(self._model, self._data)
    self._renderer.update_scene(self._data, camera="eye")
    return self._renderer.render()

  def close(self) -> None:
    """Frees the OpenGL context."""
    self._renderer.close()


def measure(
  draws: dict[str, Draw], truth: list[np.ndarray], repeats: int
) -> dict[str, dict[str, harness.Value]]:
  """Lets the drawers take turns; returns their times and PSNR by name.

  Median and p95 are processor time, all threads, because everything shares one core: on an idle
  core that is the time that passes, on a busy one it leaves out the others' turns. `elapsed_ms` is
  the median by the clock.
  """
  count = len(truth)

  def quality(draw: Draw) -> float:
    return float(np.mean([psnr(draw(view), truth[view]) for view in range(count)]))

  calls = {name: lambda i, draw=draw: draw(i % count) for name, draw in draws.items()}
  times = harness.interleave(calls, rounds=count * repeats)
  return {
    name: {
      "median_ms": (spread := times[name].figures())["processor_median_ms"],
      "p95_ms": spread["processor_p95_ms"],
      "elapsed_ms": spread["median_ms"],
      "psnr_db": quality(draw),
      "views": count,
    }
    for name, draw in draws.items()
  }


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  harness.one_core(settings.core)
  field, room_from_unit = load_field(settings)
  unit_from_room = room_from_unit.inverse()
  poses = robot_poses(settings.views)
  unit_poses = unit_from_room.apply_pose(poses)
  render.Renderer(field)  # compiles the kernels where they are not in the cache
  start = time.perf_counter()
  renderer = render.Renderer(field)
  ready = time.perf_counter() - start
  figures: dict[str, dict[str, harness.Value]] = {"start": {"ready_s": ready}}
  for height, width in SIZES:
    camera = Camera.from_vertical_fov(FIELD_OF_VIEW, width, height)
    with room.room_eye() as eye:
      truth = [room.true_view(camera, pose, eye=eye)[0] for pose in poses]
    fast, standard = (MujocoDrawer(camera, poses, fast=fast) for fast in (True, False))

    def fused(view: int, camera: Camera = camera) -> np.ndarray:
      return renderer.render(camera, unit_poses[view])[0]

    draws: dict[str, Draw] = {
      "field_warp": fused,
      "mujoco_fast_flags": fast.draw,
      "mujoco_default_flags": standard.draw,
    }
    for name, row in measure(draws, truth, settings.repeats).items():
      figures[f"{height}x{width}_{name}"] = row
    fast.close()
    standard.close()
  details = {
    "render": dataclasses.asdict(renderer.settings),
    "field": dataclasses.asdict(field.settings),
  }
  harness.finish(
    "render",
    figures,
    settings,
    seed=POSE_SEED,
    details=details,
    words=f"For comparison: the paper's renderer takes {PAPER_MS:.0f} ms a frame on a V100.",
  )


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
