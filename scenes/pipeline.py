"""The main job: from a capture to a scene bundle, stage by stage.

  keyframes -> poses -> field -> figures -> depth -> world frame -> surface -> contact -> bundle

Each stage is a function of files and settings to a folder; `scenes.stages` caches them.
"""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from nerf2real.core import files
from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import read_json, write_json
from nerf2real.scenes import assembly, bundle, stages
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.capture import CaptureSettings, read_capture, source_kind
from nerf2real.scenes.field import anchors, photometry
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.fused.trainer import FusedField
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.settings import preset as train_preset
from nerf2real.scenes.field.training import train
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.geometry import align as aligning
from nerf2real.scenes.geometry import collision as contact
from nerf2real.scenes.geometry import convex, fusion, markers, overrides, poisson
from nerf2real.scenes.geometry import mesh as meshing
from nerf2real.scenes.geometry.free_space import FreeSpaceSettings, free_space
from nerf2real.scenes.poses import localise as localising
from nerf2real.scenes.quality import collision_error, image_quality
from nerf2real.scenes.quality import held_out as evaluate

STAGES = ".stages"  # folder of the cached stages inside a bundle


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSettings:
  """Settings of the whole job; each part is a stage's own settings."""

  capture: CaptureSettings = CaptureSettings()
  """Keyframes."""
  localise: localising.LocaliseSettings = localising.LocaliseSettings()
  """Poses."""
  train: TrainSettings = TrainSettings()
  """Radiance field."""
  train_width: int = 1280
  """Wider pictures are reduced to this width for training [pixel]. Ours: memory."""
  held_out_every: int = 8
  """Every so many keyframes one is kept from training. Mip-NeRF 360's convention."""
  depth_width: int = 320
  """Width of the depth pictures that geometry is made from [pixel]. Ours."""
  align: aligning.AlignSettings = aligning.AlignSettings()
  """World frame."""
  marker_side: float | None = None
  """Side of the black square of ArUco or AprilTag markers in the room [m]; None: no marker."""
  mesh: meshing.MeshSettings = meshing.MeshSettings()
  """Surface mesh."""
  collision: contact.CollisionSettings = contact.CollisionSettings()
  """Contact geometry."""
  free_space: FreeSpaceSettings = FreeSpaceSettings()
  """Map of the free floor."""
  baseline: str = "none"
  """"colmap" adds the Poisson mesh of the COLMAP points to the report, as the paper compares."""

  def __post_init__(self):
    if self.baseline not in ("none", "colmap"):
      raise ValueError(f"Unknown baseline {self.baseline!r}; expected 'none' or 'colmap'.")


PRESETS = ("fast", "demo", "paper")


def preset(name: str) -> SceneSettings:
  """Returns settings: "fast" for two CPU cores, "demo" quicker, "paper" the paper's tables."""
  if name == "fast":
    return SceneSettings()
  if name == "demo":
    return SceneSettings(
      capture=CaptureSettings(num_keyframes=110),
      train=dataclasses.replace(train_preset("fast"), max_seconds=150.0),
      baseline="colmap",
    )
  if name == "paper":
    return SceneSettings(
      capture=CaptureSettings(num_keyframes=1000), train=train_preset("paper"), train_width=1920
    )
  raise ValueError(f"Unknown preset {name!r}; expected one of {', '.join(PRESETS)}.")


def make_scene(
  source: Path,
  out: Path,
  *,
  settings: SceneSettings,
  override: Path | None = None,
  name: str | None = None,
  measure: assembly.Measure | None = None,
  show_progress: bool = True,
) -> bundle.Bundle:
  """Makes a scene bundle from a capture.

  Args:
    source: A video, a folder of pictures, a COLMAP model or a transforms.json.
    out: The bundle's folder; stages are cached in it.
    settings: Settings of all stages.
    override: File that fixes what would be found automatically, see `scenes.geometry.overrides`.
    name: The scene's name; that of the output folder if None.
    measure: Adds figures against a known truth.
    show_progress: Whether to draw progress bars.

  Returns:
    The finished bundle.

  Raises:
    ValueError: The capture or a setting cannot be used; the message is one line.
  """
  out = Path(out)
  fixed = overrides.read(override) if override else None
  source_kind(Path(source))  # raises where it cannot be used
  source_key = files.hash_path(source)
  override_key = files.hash_path(override) if override else ""
  cache = stages.Stages(out / STAGES, show_progress=show_progress)
  job = Job(Path(source), source_key, settings, cache, override=fixed, override_key=override_key)
  job.keyframes()
  job.poses()
  job.train()
  job.depth()
  job.figures()
  job.world()
  job.surface()
  job.contact()
  if settings.baseline == "colmap":
    job.poisson()
  return assembly.assemble(job, out, name=name or out.name, measure=measure)


class Job:
  """The stages, in order; each method runs one and keeps its result."""

  def __init__(
    self,
    source: Path,
    source_key: str,
    settings: SceneSettings,
    cache: stages.Stages,
    *,
    override: overrides.Overrides | None = None,
    override_key: str = "",
  ):
    self.source, self.source_key = source, source_key
    self.settings, self.stages = settings, cache
    self._override, self._override_key = override, override_key
    self._renderer: Renderer | None = None

  def folder(self, stage: str) -> Path:
    return self.stages.results[stage].folder

  def _keys(self, *names: str) -> dict[str, str]:
    return {name: self.stages.results[name].made for name in names}

  def load(self, stage: str, file: str) -> dict[str, Any]:
    return json.loads((self.folder(stage) / file).read_text())

  def keyframes(self) -> None:
    """Writes the sharpest frames."""

    def run(folder: Path, progress: Progress) -> None:
      taken = read_capture(
        self.source, folder / "images", settings=self.settings.capture, progress=progress
      )
      keyframes.save(taken, folder)

    self.stages.run(
      "keyframes", run, settings=self.settings.capture, inputs={"source": self.source_key}
    )
    folder = self.folder("keyframes")
    self.capture = keyframes.load(folder, folder / "images")

  def poses(self) -> None:
    """Finds the camera and its poses."""

    def run(folder: Path, progress: Progress) -> None:
      localising.localise(
        self.capture.folder,
        folder,
        settings=self.settings.localise,
        known=self.capture.known,
        progress=progress,
      )
      shutil.rmtree(folder / "work", ignore_errors=True)  # features and matches: large

    self.stages.run("poses", run, settings=self.settings.localise, inputs=self._keys("keyframes"))
    self.localisation = localising.load(self.folder("poses") / "sfm")

  def views(self) -> Views:
    """The registered keyframes at training size."""
    found = self.localisation
    camera = found.camera
    if camera.width > self.settings.train_width:
      height = round(camera.height * self.settings.train_width / camera.width)
      camera = camera.resized(self.settings.train_width, height)
    images = []
    for image_name in found.names:
      path = self.folder("keyframes") / "images" / image_name
      image = cv2.imread(str(path))
      if image is None:
        raise ValueError(f"The keyframe {path} cannot be read: delete {path.parent.parent}.")
      if image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
      images.append(image[..., ::-1])
    model, pictures = pycolmap.Reconstruction(str(self.folder("poses") / "sfm")), np.stack(images)
    seen = photometry.point_colors(model, found.names, pictures)
    gains = photometry.picture_gains(*seen, count=len(images))
    known = anchors.known_points(model, found.names, found.world_from_camera, camera=camera)
    return Views(camera, pictures, found.world_from_camera, found.names, gains, anchors=known)

  def train(self) -> None:
    """Trains the field on all views that are not held out."""
    settings = {
      "train": self.settings.train,
      "held_out_every": self.settings.held_out_every,
      "train_width": self.settings.train_width,
    }

    def run(folder: Path, progress: Progress) -> None:
      training, _ = self.views().split(self.settings.held_out_every)
      field, outcome = train(
        training.evened(),
        self.settings.train,
        progress=progress,
        checkpoint_dir=folder / "checkpoints",
      )
      field.save(folder / "field.safetensors")
      write_json(folder / "training.json", outcome)
      shutil.rmtree(folder / "checkpoints", ignore_errors=True)

    self.stages.run("field", run, settings=settings, inputs=self._keys("poses"))

  @property
  def renderer(self) -> Renderer:
    """The field, ready to render."""
    if self._renderer is None:
      field = Field.load(self.folder("field") / "field.safetensors")
      self._renderer = Renderer(field, threads=os.cpu_count() or 1)
    return self._renderer

  def figures(self) -> None:
    """Scores the held-out views."""

    def run(folder: Path, progress: Progress) -> None:
      _, held_out = self.views().split(self.settings.held_out_every)
      scores, figures = evaluate.evaluate(self.renderer, held_out, progress=progress)
      figures["exposure_ratio"] = photometry.exposure_ratio(held_out.gains)
      evaluate.save_scores(scores, folder)
      write_json(folder / "figures.json", figures)

    self.stages.run(
      "figures", run, settings=self.settings.held_out_every, inputs=self._keys("field")
    )

  def depth(self) -> None:
    """Renders depth where the capture's cameras stood."""

    def run(folder: Path, progress: Progress) -> None:
      camera = self.localisation.camera
      width = min(self.settings.depth_width, camera.width)
      camera = camera.resized(width, round(camera.height * width / camera.width))
      color, depth = [], []
      poses = self.localisation.world_from_camera
      for index, pose in enumerate(poses):
        picture = self.renderer.render(camera, pose)
        color.append(picture[0])
        depth.append(picture[1])
        progress((index + 1) / len(poses), f"picture {index + 1} of {len(poses)}")
      np.savez(folder / "depth.npz", color=np.stack(color), depth=np.stack(depth))

    self.stages.run(
      "depth", run, settings=self.settings.depth_width, inputs=self._keys("field", "poses")
    )
    arrays = np.load(self.folder("depth") / "depth.npz")
    height, width = arrays["depth"].shape[1:]
    self.unit_depth = fusion.DepthViews(
      camera=self.localisation.camera.resized(width, height),
      frame_from_camera=self.localisation.world_from_camera,
      depth=arrays["depth"],
      color=arrays["color"],
    )

  def world(self) -> None:
    """Finds floor, scale, yaw and extent."""
    settings = {
      "align": self.settings.align,
      "marker_side": self.settings.marker_side,
      "override": self._override_key,
    }

    def run(folder: Path, progress: Progress) -> None:
      found = self.localisation
      marker = None
      if self.settings.marker_side is not None:
        images = self.folder("keyframes") / "images"
        detections = markers.detect(
          [images / image for image in found.names],
          progress=part(progress, 0.0, 0.6),
        )
        marker = markers.marker_scale(
          detections,
          camera=found.camera,
          frame_from_camera=found.world_from_camera,
          side=self.settings.marker_side,
        )
      points, normals = self.unit_depth.surface_points(stride=2)
      result = aligning.align(
        points=found.points,
        frame_from_camera=found.world_from_camera,
        surface_points=points,
        surface_normals=normals,
        marker=marker,
        settings=self.settings.align,
        override=self._override,
        progress=part(progress, 0.6, 1.0),
      )
      if self.settings.marker_side is not None and marker is None:
        missing = (
          f"No marker of side {self.settings.marker_side} m was read consistently in three "
          "pictures or more: print it larger, lay it flat, film it from nearer."
        )
        result = dataclasses.replace(result, warnings=(*result.warnings, missing))
      write_json(folder / "alignment.json", result)

    self.stages.run("world", run, settings=settings, inputs=self._keys("depth"))
    self.alignment = read_json(self.folder("world") / "alignment.json", aligning.Alignment)
    self.world_depth = self.unit_depth.transformed(self.alignment.world_from_unit)

  def surface(self) -> None:
    """Makes the coloured surface mesh."""
    settings = self.settings.mesh

    def run(folder: Path, progress: Progress) -> None:
      place = self.alignment
      grid = fusion.fuse(
        self.world_depth,
        lower=place.extent_lower,
        upper=place.extent_upper,
        voxel=settings.voxel,
        truncation=settings.truncation,
        progress=part(progress, 0.0, 0.5),
      )
      if settings.source == "density":
        grid = meshing.density_to_grid(
          self._densities(grid),
          lower=grid.lower,
          voxel=grid.voxel,
          threshold=settings.density_threshold,
          carved=grid,
        )
      grid = meshing.drop_floaters(grid, min_component=settings.min_component)
      found = meshing.drop_small_pieces(meshing.surface(grid), min_component=settings.min_component)
      progress(0.7, "fewer faces")
      found = meshing.simplify(found, faces=settings.visual_faces)
      progress(0.8, "colours")
      meshing.save_glb(meshing.paint(found, self.world_depth), folder / "visual.glb")

    self.stages.run("surface", run, settings=settings, inputs=self._keys("world"))

  def _densities(self, grid: fusion.Grid) -> np.ndarray:
    """The field's density [X, Y, Z] at the voxels of a grid in the world frame."""
    axes = [grid.centres(axis) for axis in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    place = self.alignment.world_from_unit.inverse()
    sigma = 0.5 * grid.voxel * place.scale
    field = FusedField(self.renderer.field)
    return field.densities(place.apply(centres.reshape(-1, 3)), sigma=sigma).reshape(
      grid.values.shape
    )

  def contact(self) -> None:
    """Makes the convex parts and the map of the free floor, and measures them."""
    settings = self.settings

    def run(folder: Path, progress: Progress) -> None:
      place = self.alignment
      shape = dataclasses.replace(settings.collision, floor_threshold=place.floor_threshold)
      top = np.minimum(place.extent_upper, [np.inf, np.inf, shape.top])
      grid = contact.solid_grid(
        self.world_depth,
        lower=place.extent_lower,
        upper=place.extent_upper,
        settings=shape,
        progress=part(progress, 0.0, 0.2),
      )
      parts = convex.decompose(grid, settings=shape.parts, progress=part(progress, 0.2, 0.8))
      contact.write_parts(parts, folder / "collision")
      progress(0.8, "free space")
      space = free_space(
        parts,
        lower=place.extent_lower,
        upper=place.extent_upper,
        seen=grid,
        settings=settings.free_space,
      )
      space.write(folder / "free_space.pgm")
      goals = space.default_goals(
        count=settings.free_space.goals, clearance=settings.free_space.goal_clearance
      )
      progress(0.85, "distance to the seen surface")
      points, _ = self.world_depth.surface_points(stride=2)
      error = collision_error.collision_error(
        parts,
        points,
        eyes=self.world_depth.positions,
        lower=place.extent_lower,
        upper=top,
        floor_threshold=place.floor_threshold,
      )
      values = {
        "goals": goals.tolist(),
        "free_area_m2": float(space.reachable.sum() * space.resolution**2),
        "collision_parts": len(parts),
        "collision_error_m": error.p95,
        "collision_error": error,
      }
      write_json(folder / "contact.json", values)

    self.stages.run(
      "contact", run, settings=[settings.collision, settings.free_space], inputs=self._keys("world")
    )

  def poisson(self) -> None:
    """Renders the paper's baseline, the Poisson mesh of the COLMAP points, at held-out views."""

    def run(folder: Path, progress: Progress) -> None:
      found = self.localisation
      _, held_out = self.views().split(self.settings.held_out_every)
      progress(0.0, "Poisson mesh")
      surface = poisson.poisson_mesh(
        found.points, found.point_colors, camera_positions=found.world_from_camera[:, :3, 3]
      )
      pictures: dict[str, Any] = {}
      for index, name in enumerate(held_out.names):
        pose = held_out.world_from_camera[index]
        picture = poisson.render_mesh(surface, held_out.camera, pose)[0]
        if held_out.gains is not None:
          picture = photometry.expose(picture, held_out.gains[index])
        pictures[name] = picture
        progress((index + 1) / (len(held_out) + 1), f"view {index + 1} of {len(held_out)}")
      np.savez(folder / "views.npz", **pictures)
      quality = [
        image_quality.psnr(pictures[name], held_out.images[index])
        for index, name in enumerate(held_out.names)
      ]
      write_json(folder / "figures.json", {"baseline_psnr_db": float(np.mean(quality))})

    self.stages.run(
      "baseline", run, settings=self.settings.held_out_every, inputs=self._keys("poses")
    )
