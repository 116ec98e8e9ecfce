"""Classifies a capture by its path: video, pictures, or a data set with known poses."""

import collections
import re
from pathlib import Path

from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.media.stills import IMAGE_SUFFIXES, list_images, list_images_below
from nerf2real.scenes.capture.posed.colmap_model import find_colmap_model
from nerf2real.scenes.capture.posed.rgbd import find_rgbd
from nerf2real.scenes.capture.posed.transforms import find_transforms
from nerf2real.scenes.capture.posed.tum import TRAJECTORY, lists_without_poses

EXPORT_STREAM = (
  "export its pictures, depth and poses with ScanNet's SensReader (reader.py "
  "--export_color_images --export_depth_images --export_poses --export_intrinsics), and give that "
  "folder."
)
_NAMED = 4  # kinds of files in a message
_MEASURED = re.compile(r"depth|pose|traj|camera|\.log$", re.IGNORECASE)  # of other tools' layouts
_VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".3gp")


def source_kind(source: Path) -> str:
  """Returns the kind of a source: "video", "images", "colmap", "transforms" or "rgbd".

  Raises:
    CaptureError: If it does not exist or is none of these.
  """
  if not source.exists():
    raise CaptureError(f"{source} does not exist.")
  try:
    str(source).encode()
  except UnicodeEncodeError as error:
    raise CaptureError(f"The name of {source} is no UTF-8: rename it.") from error
  if find_transforms(source) is not None:
    return "transforms"
  if find_rgbd(source) is not None:
    return "rgbd"
  if source.suffix.lower() == ".sens":
    raise CaptureError(f"{source} is ScanNet's stream: {EXPORT_STREAM}")
  if not source.is_dir():
    return "video"
  if find_colmap_model(source) is not None:
    return "colmap"
  if list_images(source) or list_images_below(source):
    return "images"
  raise CaptureError(f"{source} holds {_what_instead(source)}")


def _what_instead(source: Path) -> str:
  """Says what a folder that is no capture holds, and what to give."""
  streams = sorted(source.glob("*.sens"))
  if streams:
    return f"{streams[0].name}, ScanNet's stream: {EXPORT_STREAM}"
  below = [child.name for child in sorted(source.iterdir()) if child.is_dir() and _holds(child)]
  below.sort(key=lambda name: "depth" in name.lower())  # depth pictures alone are no capture
  if (listed := lists_without_poses(source)) is not None:
    alone = f", or give {source / below[0]} alone: its pictures are localised then" if below else ""
    return (
      f"{listed} of TUM's layout and no trajectory: expected {TRAJECTORY} beside it, with time, "
      f"position and quaternion (x, y, z, w) a line{alone}."
    )
  if below:
    chosen = source / below[0]
    said = f"no capture, but folders that do: give one of them, such as {chosen}"
    unread = [] if _posed(chosen) else sorted(filter(_MEASURED.search, _names(source, chosen)))
    alone = f"; its pictures are localised then, without {', '.join(unread[:_NAMED])}"
    return f"{said}{alone if unread else ''}."
  files = [path for path in sorted(source.iterdir()) if path.is_file() and path.name[0] != "."]
  if videos := _videos(source):
    others = f", and {len(videos) - 1} more" if len(videos) > 1 else ""
    return f"{videos[0].name}, a video{others}, and no pictures: give {videos[0]} itself."
  kinds = collections.Counter(path.suffix.lower() or "no suffix" for path in files)
  found = f" but {len(files)} other files ({', '.join(sorted(kinds)[:_NAMED])})" if files else ""
  return (
    f"no pictures, no COLMAP model and no transforms.json{found}: give a video, or a folder with "
    f"one of these; pictures are {', '.join(IMAGE_SUFFIXES)}."
  )


def _videos(folder: Path) -> list[Path]:
  """Videos of a folder by their names, without hidden files."""
  return [
    path
    for path in sorted(folder.iterdir())
    if path.suffix.lower() in _VIDEO_SUFFIXES and path.name[0] != "." and path.is_file()
  ]


def holds_more(source: Path, count: int) -> str | None:
  """Says what to give in place of a folder of `count` pictures: a folder in it, or a video."""
  if videos := _videos(source):
    return f"give the video {videos[0]} itself, or take more pictures"
  held = {child: len(list_images(child)) for child in source.iterdir() if child.is_dir()}
  most = max(held, key=lambda child: held[child], default=source)
  if held.get(most, 0) <= count:
    return None
  return f"give {most}, which holds {held[most]}, or take more"


def _posed(folder: Path) -> bool:
  """Whether a folder is a capture whose poses came along."""
  return any(finder(folder) for finder in (find_transforms, find_rgbd, find_colmap_model))


def _holds(folder: Path) -> bool:
  """Whether a folder is a capture."""
  return _posed(folder) or bool(list_images(folder) or list_images_below(folder))


def _names(*folders: Path) -> list[str]:
  """What folders hold."""
  return [path.name for folder in folders for path in folder.iterdir()]
