"""Writes a scene as Universal Scene Description (OpenUSD): metres, z up, rigid-body colliders.

Needs the library `usd-core`, the extra `export`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.scenes.export.mjcf import floor_of
from nerf2real.scenes.geometry import convex

SUFFIXES = (".usd", ".usda", ".usdc")
_SENSOR_WIDTH = 20.955  # USD's default horizontal aperture [tenths of a world unit]


def _library() -> Any:
  """Returns the module pxr.

  Raises:
    ValueError: usd-core is not installed.
  """
  try:
    import pxr
    from pxr import Gf, Usd, UsdGeom, UsdPhysics, Vt  # noqa: F401
  except ImportError as error:
    raise ValueError(
      "USD needs the library usd-core, which is not installed: pip install 'nerf2real[export]'."
    ) from error
  return pxr


def _add_mesh(stage: Any, path: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
  pxr = _library()
  mesh = pxr.UsdGeom.Mesh.Define(stage, path)
  mesh.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32)))
  mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
  corners = np.ascontiguousarray(faces.ravel(), np.int32)
  mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(corners))
  mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
  bounds = [tuple(map(float, corner)) for corner in (vertices.min(0), vertices.max(0))]
  mesh.CreateExtentAttr(bounds)
  return mesh


def _add_collider(stage: Any, path: str, part: convex.Part) -> None:
  pxr = _library()
  mesh = _add_mesh(stage, path, part.vertices, part.faces)
  mesh.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
  pxr.UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
  hull = pxr.UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim())
  hull.CreateApproximationAttr(pxr.UsdPhysics.Tokens.convexHull)


def _add_camera(stage: Any, path: str, camera: Camera, pose: np.ndarray) -> None:
  pxr = _library()
  added = pxr.UsdGeom.Camera.Define(stage, path)
  per_pixel = _SENSOR_WIDTH / camera.width
  added.CreateHorizontalApertureAttr(_SENSOR_WIDTH)
  added.CreateVerticalApertureAttr(per_pixel * camera.height)
  # USD has one focal length: fx; square pixels are assumed, as of every phone
  added.CreateFocalLengthAttr(per_pixel * camera.fx)
  added.CreateHorizontalApertureOffsetAttr(per_pixel * (camera.width / 2 - camera.cx))
  added.CreateVerticalApertureOffsetAttr(per_pixel * (camera.cy - camera.height / 2))
  matrix = np.array(pose, np.float64)
  matrix[:3, :3] = matrix[:3, :3] @ OPENGL_FROM_OPENCV
  added.AddTransformOp().Set(pxr.Gf.Matrix4d(matrix.T.tolist()))  # USD multiplies rows


def write(
  path: Path,
  *,
  visual: trimesh.Trimesh,
  parts: Sequence[convex.Part],
  extent: tuple[np.ndarray, np.ndarray],
  camera: Camera,
  world_from_camera: np.ndarray,
) -> None:
  """Writes one file: /World with the coloured surface, the colliders, the floor and a camera.

  Args:
    path: Ends in .usd, .usda or .usdc.
    visual: The surface with vertex colours, world frame.
    parts: Convex parts, world frame.
    extent: Lower and upper corner of the scene [3] each [m].
    camera: The calibrated camera; USD has no distortion.
    world_from_camera: Its pose [4, 4], OpenCV axes.

  Raises:
    ValueError: The suffix is none of USD's, or usd-core is not installed.
  """
  if path.suffix not in SUFFIXES:
    raise ValueError(f"Found the file {path}; expected one that ends in {', '.join(SUFFIXES)}.")
  pxr = _library()
  with files.atomic_path(path) as partial:
    stage = pxr.Usd.Stage.CreateNew(str(partial))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(pxr.UsdGeom.Xform.Define(stage, "/World").GetPrim())
    shown = _add_mesh(stage, "/World/visual", visual.vertices, visual.faces)
    looks: Any = visual.visual  # of vertices, as bundles have it
    colors = np.asarray(looks.vertex_colors)[:, :3] / np.float32(255)
    shown.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex).Set(
      pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colors, np.float32))
    )
    pxr.UsdGeom.Scope.Define(stage, "/World/collision")
    for number, part in enumerate(parts):
      _add_collider(stage, f"/World/collision/part_{number:03d}", part)
    floor = pxr.UsdGeom.Plane.Define(stage, "/World/floor")
    floor.CreateAxisAttr(pxr.UsdGeom.Tokens.z)
    center, half = floor_of(extent)
    floor.CreateWidthAttr(float(2 * half[0]))
    floor.CreateLengthAttr(float(2 * half[1]))
    floor.AddTranslateOp().Set(pxr.Gf.Vec3d(*center.tolist(), 0.0))
    floor.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
    pxr.UsdPhysics.CollisionAPI.Apply(floor.GetPrim())
    _add_camera(stage, "/World/camera", camera, world_from_camera)
    stage.GetRootLayer().Save()
