"""Classifies a capture by its path: video, pictures, or a data set with known poses."""

from pathlib import Path

from nerf2real.scenes.capture import stills
from nerf2real.scenes.capture.rgbd import find_rgbd
from nerf2real.scenes.capture.sources import find_colmap_model, find_transforms, list_images
from nerf2real.scenes.capture.video import CaptureError


def source_kind(source: Path) -> str:
  """Returns the kind of a source: "video", "images", "colmap", "transforms" or "rgbd".

  Raises:
    CaptureError: If it does not exist or is none of these.
  """
  if not source.exists():
    raise CaptureError(f"{source} does not exist.")
  if find_transforms(source) is not None:
    return "transforms"
  if find_rgbd(source) is not None:
    return "rgbd"
  if not source.is_dir():
    return "video"
  if find_colmap_model(source) is not None:
    return "colmap"
  if list_images(source) or list_images_below(source):
    return "images"
  raise CaptureError(f"{source} holds {_what_instead(source)}")


def _what_instead(source: Path) -> str:
  """Says what a folder that is no capture holds, and what to give."""
  below = [child.name for child in sorted(source.iterdir()) if child.is_dir() and _holds(child)]
  if below:
    return f"no capture, but folders that do: give one of them, such as {source / below[0]}."
  apple = stills.apple_pictures(source)
  if apple:
    return (
      f"{len(apple)} pictures such as {apple[0].name}, which OpenCV does not read: convert them to "
      "JPEG, or set the phone to its most compatible format."
    )
  return (
    "no pictures, no COLMAP model and no transforms.json: give a video, or a folder with one of "
    "these."
  )


def _holds(folder: Path) -> bool:
  """Whether a folder is a capture."""
  finders = (find_transforms, find_rgbd, find_colmap_model, list_images, list_images_below)
  return any(finder(folder) for finder in finders)


def list_images_below(source: Path) -> list[Path]:
  """Lists the pictures in source/images, the usual place beside a model."""
  return list_images(source / "images") if (source / "images").is_dir() else []
