"""Stages that judge: the field on held-out pictures, contact geometry, the paper's baseline.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.progress import Progress
from nerf2real.core.serialization import read_json, write_json
from nerf2real.scenes.alignment.world_frame import Alignment
from nerf2real.scenes.field import photometry
from nerf2real.scenes.field.render import renderer
from nerf2real.scenes.field.views import held_out_rows
from nerf2real.scenes.geometry import poisson as poisson_meshes
from nerf2real.scenes.geometry.fusion import DepthViews
from nerf2real.scenes.quality import held_out, image_quality, sight_lines
from nerf2real.scenes.quality.collision_error import collision_error
from nerf2real.scenes.stages.cache import Made, Stages
from nerf2real.scenes.stages.pictures import PosedPictures
from nerf2real.scenes.stages.results import Contact, ContactErrors, TrainedField


def figures(
  cache: Stages, field: Made[TrainedField], pictures: PosedPictures
) -> Made[dict[str, float]]:
  """Scores the field on the held-out pictures."""

  def write(folder: Path, progress: Progress) -> None:
    views = pictures.held_out()
    scores, found = held_out.evaluate(field.value.renderer, views, progress=progress)
    if views.exposure is not None:
      found["exposure_ratio"] = views.exposure.ratio
      found["corner_light"] = views.exposure.corner
    held_out.save_scores(scores, folder)
    write_json(folder / "figures.json", found)

  inputs = {"field": field.stamp}
  every = pictures.held_out_every
  stage = cache.run("figures", write, settings=every, inputs=inputs, version=renderer.VERSION)
  return Made(json.loads((stage.folder / "figures.json").read_text()), stage)


def contact_errors(
  cache: Stages,
  world: Made[Alignment],
  depth: Made[DepthViews],
  contact: Made[Contact],
  pictures: PosedPictures,
  *,
  top: float,
) -> Made[ContactErrors]:
  """Measures the convex parts against the depth that they were made of, and by sight lines.

  Args:
    cache: The stages of the job.
    world: The world frame.
    depth: Depth in it.
    contact: The convex parts.
    pictures: The localised pictures; those held out judge by sight lines.
    top: Height up to which contact geometry is made [m].
  """
  place, poses = world.value, pictures.poses

  def write(folder: Path, progress: Progress) -> None:
    parts = contact.value.parts
    upper = np.minimum(place.extent_upper, [np.inf, np.inf, top])
    error = collision_error(
      parts,
      depth.value.surface_points(stride=2)[0],
      eyes=depth.value.positions,
      lower=place.extent_lower,
      upper=upper,
      floor_threshold=place.floor_threshold,
    )
    progress(0.5, "sight lines")
    lines = sight_lines.sight_lines(
      poses.value,
      held_out_rows(len(poses.value.names), pictures.held_out_every),
      place.world_from_unit,
      lower=place.extent_lower,
      upper=upper,
    )
    found = ContactErrors(error, sight_lines.judge_parts(lines, parts))
    write_json(folder / "errors.json", found)

  inputs = {"world": world.stamp, "depth": depth.stamp, "contact": contact.stamp}
  inputs["poses"] = poses.stamp
  stage = cache.run("contact_errors", write, settings=[top, pictures.held_out_every], inputs=inputs)
  return Made(read_json(stage.folder / "errors.json", ContactErrors), stage)


def baseline(cache: Stages, pictures: PosedPictures) -> Made[dict[str, float]]:
  """Renders the paper's baseline, the Poisson mesh of the COLMAP points, at held-out views."""
  poses = pictures.poses

  def write(folder: Path, progress: Progress) -> None:
    found, views = poses.value, pictures.held_out()
    progress(0.0, "Poisson mesh")
    surface = poisson_meshes.poisson_mesh(
      found.points, found.point_colors, camera_positions=found.world_from_camera[:, :3, 3]
    )
    drawn: dict[str, Any] = {}
    for index, name in enumerate(views.names):
      pose = views.world_from_camera[index]
      picture = poisson_meshes.render_mesh(surface, views.camera, pose)[0]
      if views.exposure is not None:
        picture = photometry.expose(picture, views.exposure.factors(index, views.camera))
      drawn[name] = picture
      progress((index + 1) / (len(views) + 1), f"view {index + 1} of {len(views)}")
    np.savez(folder / "views.npz", **drawn)
    quality = [
      image_quality.psnr(drawn[name], views.images[index]) for index, name in enumerate(views.names)
    ]
    write_json(folder / "figures.json", {"baseline_psnr_db": float(np.mean(quality))})

  inputs = {"poses": poses.stamp}
  everything = {"held_out_every": pictures.held_out_every, "train_width": pictures.width}
  stage = cache.run("baseline", write, settings=everything, inputs=inputs)
  return Made(json.loads((stage.folder / "figures.json").read_text()), stage)
