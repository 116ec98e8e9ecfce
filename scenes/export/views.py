"""Renders a bundle's field where its capture's cameras stood: colour and depth, world frame."""

import os

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.poses import localisation


def renderer_of(bundle: Bundle) -> Renderer:
  """Loads the field of a bundle, ready to render on all cores."""
  return Renderer(Field.load(bundle.field_path), threads=os.cpu_count() or 1)


def capture_cameras(bundle: Bundle) -> tuple[Camera, np.ndarray, tuple[str, ...]]:
  """Returns the capture's camera, its poses [N, 4, 4] in the world frame and the pictures' names.

  Raises:
    LocalisationError: The bundle's folder sfm/ is missing or damaged.
  """
  found = localisation.load(bundle.folder / "sfm")
  poses = bundle.world_from_unit.apply_pose(found.world_from_camera)
  return found.camera, poses, found.names


def overlooking_view(bundle: Bundle) -> tuple[Camera, np.ndarray]:
  """The capture's camera and its pose [4, 4], world frame, with the most points before the lens.

  Raises:
    LocalisationError: The bundle's folder sfm/ is missing or damaged.
  """
  found = localisation.load(bundle.folder / "sfm")
  pose = found.world_from_camera[found.overlooking()]
  return found.camera, bundle.world_from_unit.apply_pose(pose)


def render_views(
  bundle: Bundle,
  renderer: Renderer,
  camera: Camera,
  world_from_camera: np.ndarray,
  *,
  progress: Progress = no_progress,
) -> fusion.DepthViews:
  """Renders pictures of a camera at poses [N, 4, 4] in the world frame; depth in metres."""
  scale, unit_from_world = bundle.world_from_unit.scale, bundle.world_from_unit.inverse()
  colors, depths = [], []
  for index, pose in enumerate(world_from_camera):
    color, depth = renderer.render(camera, unit_from_world.apply_pose(pose))
    colors.append(color)
    depths.append((scale * depth).astype(np.float32))
    progress((index + 1) / len(world_from_camera), f"picture {index + 1}")
  return fusion.DepthViews(
    camera=camera,
    frame_from_camera=np.asarray(world_from_camera),
    depth=np.stack(depths),
    color=np.stack(colors),
  )


def capture_views(
  bundle: Bundle,
  renderer: Renderer,
  *,
  width: int,
  count: int,
  progress: Progress = no_progress,
) -> fusion.DepthViews:
  """Renders the field at up to `count` evenly chosen poses of the capture, at a width [pixel]."""
  camera, poses, _ = capture_cameras(bundle)
  chosen = np.unique(np.linspace(0, len(poses) - 1, count).astype(int))
  return render_views(bundle, renderer, camera.at_most(width), poses[chosen], progress=progress)
