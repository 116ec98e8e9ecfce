"""Stages that make geometry of depth: corrections, surface mesh, contact geometry with free floor.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import read_json, write_json
from nerf2real.scenes.alignment import world_frame
from nerf2real.scenes.field.views import held_out_rows
from nerf2real.scenes.geometry import (
  collision,
  decomposition,
  floor_plan,
  fusion,
  map_server,
  mesh,
)
from nerf2real.scenes.geometry.corrections import plain_surfaces, seen_floor, seen_through
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from nerf2real.scenes.stages.pictures import PosedPictures
from nerf2real.scenes.stages.results import Contact, FreeFloor, Moved

_SURFACE_VERSION = 2  # 2: the floor is inside of the grid
# 2: unseen space is matter behind seen matter alone; no tolerance grows; 3: its errors apart;
# 4: the tolerance holds between voxels; 5: thin things; 6: no side is cut off round parts;
# 7: ends of columns in their own arithmetic
_CONTACT_VERSION = 7


def corrected(
  cache: Stages,
  world: Made[world_frame.Alignment],
  depth: fusion.DepthViews,
  pictures: PosedPictures,
  settings: collision.CollisionSettings,
) -> tuple[Made[fusion.DepthViews], Moved]:
  """Moves the surface of depth in the world frame where it cannot be right.

  To the floor where pictures show the floor, and plain regions onto planes. The held-out pictures
  take no part: they judge the geometry.
  """
  place = world.value

  def write(folder: Path, progress: Progress) -> None:
    shown = dataclasses.replace(pictures, width=depth.camera.width).views().evened()
    floored = seen_floor.with_seen_floor(
      depth,
      np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in shown.images]),
      np.flatnonzero(~held_out_rows(len(shown), pictures.held_out_every)),
      lower=place.extent_lower,
      upper=np.minimum(place.extent_upper, [np.inf, np.inf, settings.top]),
      progress=part(progress, 0.0, 0.5),
    )
    flat = plain_surfaces.on_planes(floored, progress=part(progress, 0.5, 0.8))
    closed = seen_through.closed(flat, _moved(floored, flat), progress=part(progress, 0.8, 1.0))
    np.save(folder / "depth.npy", closed.depth)
    shares = _moved(depth, floored).mean(), _moved(floored, closed).mean()
    write_json(folder / "moved.json", Moved(*map(float, shares)))

  everything = [settings.top, pictures.held_out_every]
  inputs = {"world": world.stamp}
  stage = cache.run("corrected", write, settings=everything, inputs=inputs)
  result = dataclasses.replace(depth, depth=np.load(stage.folder / "depth.npy"))
  return Made(result, stage), read_json(stage.folder / "moved.json", Moved)


def _moved(before: fusion.DepthViews, after: fusion.DepthViews) -> np.ndarray:
  """Which pixels [N, H, W] lie elsewhere."""
  return (after.depth != before.depth) & np.isfinite(after.depth)


def surface(
  cache: Stages,
  world: Made[world_frame.Alignment],
  depth: Made[fusion.DepthViews],
  settings: mesh.MeshSettings,
) -> StageResult:
  """Makes the coloured surface mesh of depth in the world frame."""

  def write(folder: Path, progress: Progress) -> None:
    # The extent ends at the floor, which is noisy: of a grid that ends there half of it was lost.
    below = np.array([0.0, 0.0, settings.truncation])
    grid = fusion.fuse(
      depth.value,
      lower=world.value.extent_lower - below,
      upper=world.value.extent_upper,
      voxel=settings.voxel,
      truncation=settings.truncation,
      progress=part(progress, 0.0, 0.5),
    )
    grid = mesh.drop_floaters(grid, min_component=settings.min_component)
    found = mesh.drop_small_pieces(mesh.surface(grid), min_component=settings.min_component)
    progress(0.7, "fewer faces")
    found = mesh.simplify(found, faces=settings.visual_faces)
    progress(0.8, "colours")
    mesh.save_glb(mesh.paint(found, depth.value), folder / "visual.glb")

  inputs = {"world": world.stamp, "depth": depth.stamp}
  return cache.run("surface", write, settings=settings, inputs=inputs, version=_SURFACE_VERSION)


def contact(
  cache: Stages,
  world: Made[world_frame.Alignment],
  depth: Made[fusion.DepthViews],
  collision_settings: collision.CollisionSettings,
  floor_settings: floor_plan.FreeSpaceSettings,
) -> Made[Contact]:
  """Makes the convex parts and the map of the free floor of depth in the world frame."""
  place = world.value

  def write(folder: Path, progress: Progress) -> None:
    grid = collision.solid_grid(
      depth.value,
      lower=place.extent_lower,
      upper=place.extent_upper,
      floor_threshold=place.floor_threshold,
      settings=collision_settings,
      progress=part(progress, 0.0, 0.2),
    )
    parts = decomposition.decompose(
      grid, settings=collision_settings.parts, progress=part(progress, 0.2, 0.8)
    )
    collision.write_parts(parts, folder / "collision")
    progress(0.8, "free space")
    space = floor_plan.floor_plan(
      parts,
      lower=place.extent_lower,
      upper=place.extent_upper,
      seen=grid,
      settings=floor_settings,
    )
    map_server.write(space, folder / "free_space.pgm")
    goals = np.zeros((0, 2))
    if space.reachable.any():
      goals = space.default_goals(
        count=floor_settings.goals, clearance=floor_settings.goal_clearance
      )
    write_json(folder / "contact.json", FreeFloor(goals, space.area))

  everything = [collision_settings, floor_settings]
  inputs = {"world": world.stamp, "depth": depth.stamp}
  stage = cache.run("contact", write, settings=everything, inputs=inputs, version=_CONTACT_VERSION)
  parts = collision.read_parts(stage.folder / "collision")
  return Made(Contact(parts, read_json(stage.folder / "contact.json", FreeFloor)), stage)
