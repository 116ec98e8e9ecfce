"""Judges splats of the built-in room with a foreign renderer: MuJoCo Warp on its CPU device.

  python launch/export_scene.py --to splat --out out/room.ply
  python benchmarks/rooms/splats.py --splats out/room.ply

The pictures are the film's own from the robot's 24 places, 60x80.
"""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np

from benchmarks import harness
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain
from nerf2real.scenes.builtin import ground_truth
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.export.mjcf import mujoco_quaternion
from nerf2real.scenes.export.splats.splats import Splats
from nerf2real.scenes.export.views import render_views, renderer_of
from nerf2real.scenes.quality.image_quality import psnr

_HEIGHT, _WIDTH = 60, 80


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to judge."""

  splats: Path
  """PLY of the built-in room."""
  scene: Path | None = None
  """Folder of the bundle that it was made of; the shipped one if not given."""
  samples: int = 1
  """Samples a pixel of the renderer."""


def draw_with_mujoco_warp(splats: Splats, poses: np.ndarray, *, samples: int) -> np.ndarray:
  """Draws splats at poses [N, 4, 4] (OpenCV axes): uint8 [N, H, W, 3]."""
  import mujoco_warp

  spec = mujoco.MjSpec()
  for number, pose in enumerate(poses):
    fov = float(np.degrees(ground_truth.robot_camera(_HEIGHT, _WIDTH).vertical_fov))
    spec.worldbody.add_camera(
      name=f"view_{number}", pos=pose[:3, 3], quat=mujoco_quaternion(pose), fovy=fov
    )
  # a scene needs one geom; it lies out of sight
  spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0, 0, -50])
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  context = mujoco_warp.create_render_context(
    model,
    cam_res=(_WIDTH, _HEIGHT),
    render_rgb=True,
    samples_per_pixel=samples,
    splat_position=splats.positions.astype(np.float32),
    splat_rotation=splats.rotations.astype(np.float32),
    splat_scale=splats.scales.astype(np.float32),
    splat_rgba=np.c_[np.clip(splats.colors, 0, 1), splats.opacities].astype(np.float32),
  )
  mujoco_warp.render(mujoco_warp.put_model(model), mujoco_warp.put_data(model, data), context)
  packed = context.rgb_data.numpy()[0].reshape(len(poses), _HEIGHT, _WIDTH)
  return np.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], -1).astype(np.uint8)


def main(settings: Settings) -> None:
  """Draws and prints the table."""
  bundle = Bundle.load() if settings.scene is None else Bundle.load(settings.scene)
  arrays = np.load(ground_truth.ROBOT_VIEWS)
  world_from_room = from_plain(bundle.figures["room_from_world"], Similarity).inverse()
  poses = world_from_room.apply_pose(arrays["world_from_camera"])
  truth = arrays[f"images_{_HEIGHT}x{_WIDTH}"]
  field = render_views(
    bundle, renderer_of(bundle), ground_truth.robot_camera(_HEIGHT, _WIDTH), poses
  ).color
  assert field is not None
  splats = Splats.load_ply(settings.splats)
  drawn = draw_with_mujoco_warp(splats, poses, samples=settings.samples)
  pairs = {
    "field_against_truth": (field, truth),
    "splats_against_truth": (drawn, truth),
    "splats_against_field": (drawn, field),
  }
  figures: dict[str, dict[str, harness.Value]] = {
    name: {"psnr_db": float(np.mean([psnr(a, b) for a, b in zip(*pair, strict=True)]))}
    for name, pair in pairs.items()
  }
  harness.finish("splats", figures, settings, words=f"{len(splats)} splats, mean of 24 pictures")


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
