"""Tiny synthetic captures for tests: textured planes seen by a known camera, and videos."""

import functools
import json
from pathlib import Path

import av
import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera

CAMERA = Camera(width=320, height=240, fx=280.0, fy=280.0, cx=160.0, cy=120.0)


@functools.cache
def texture(seed: int, size: int = 512) -> np.ndarray:
  """A picture rich in features: noise at several scales, BGR uint8 [size, size, 3]."""
  generator = np.random.default_rng(seed)
  result = np.zeros((size, size, 3), np.float32)
  for cells in (8, 16, 32, 64, 128):
    noise = generator.uniform(-1, 1, (cells, cells, 3)).astype(np.float32)
    result += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
  result -= result.min()
  return (255 * result / result.max()).astype(np.uint8)


# Each plane: corner, two edges [m] in a world with z up. A corner of a room: floor and two walls.
PLANES = (
  (np.array([0.0, 0.0, 0.0]), np.array([3.0, 0, 0]), np.array([0, 3.0, 0])),
  (np.array([0.0, 3.0, 0.0]), np.array([3.0, 0, 0]), np.array([0, 0, 3.0])),
  (np.array([3.0, 0.0, 0.0]), np.array([0, 3.0, 0]), np.array([0, 0, 3.0])),
)


CORNER = tuple((texture(seed), *plane) for seed, plane in enumerate(PLANES))

# The corner, less rich in features, with one picture on both of its walls.
TWO_ALIKE = (
  *((texture(seed, 40), *plane) for seed, plane in enumerate(PLANES)),
  (texture(3), np.array([0.8, 2.99, 0.7]), np.array([0.9, 0, 0]), np.array([0, 0, 0.9])),
  (texture(3), np.array([2.99, 2.2, 0.7]), np.array([0, -0.9, 0]), np.array([0, 0, 0.9])),
)
FIRST_FROM_SECOND = np.array(  # moves the second of the two to where the first is
  [[0.0, -1, 0, 3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
)


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
  """World-from-camera pose [4, 4] of an upright camera, OpenCV axes."""
  forward = (target - position) / np.linalg.norm(target - position)
  right = np.cross(forward, [0.0, 0.0, 1.0])
  right /= np.linalg.norm(right)
  pose = np.eye(4)
  pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
  pose[:3, 3] = position
  return pose


def render(world_from_camera: np.ndarray, camera: Camera = CAMERA, surfaces=CORNER) -> np.ndarray:
  """Renders the planes by one homography each, the nearest in front: BGR uint8 [H, W, 3]."""
  return cast(world_from_camera, camera, surfaces)[0]


def cast(
  world_from_camera: np.ndarray, camera: Camera = CAMERA, surfaces=CORNER
) -> tuple[np.ndarray, np.ndarray]:
  """Renders the planes: BGR uint8 [H, W, 3] and z-depth [H, W] [m], inf where there is nothing."""
  image = np.zeros((camera.height, camera.width, 3), np.uint8)
  depth = np.full((camera.height, camera.width), np.inf)
  rays = camera.rays()
  origin, rotation = world_from_camera[:3, 3], world_from_camera[:3, :3]
  directions = rays @ rotation.T
  for picture, corner, first, second in surfaces:
    normal = np.cross(first, second)
    along = directions @ normal
    distance = ((corner - origin) @ normal) / np.where(np.abs(along) < 1e-9, 1e-9, along)
    hit = origin + distance[..., None] * directions - corner
    u, v = hit @ first / (first @ first), hit @ second / (second @ second)
    inside = (distance > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (distance < depth)
    scale = len(picture) - 1
    colors = cv2.remap(
      picture, (u * scale).astype(np.float32), (v * scale).astype(np.float32), cv2.INTER_LINEAR
    )
    image[inside] = colors[inside]
    depth[inside] = distance[inside]
  return image, depth


def walk(count: int) -> np.ndarray:
  """Poses [N, 4, 4] of a short arc that looks into the corner of the planes."""
  poses = []
  for step in np.linspace(0, 1, count):
    position = np.array([0.3 + 1.0 * step, 1.3 - 0.9 * step, 1.2 + 0.2 * np.sin(5 * step)])
    poses.append(look_at(position, np.array([2.4, 2.4, 0.8])))
  return np.stack(poses)


def write_images(folder: Path, poses: np.ndarray, surfaces=CORNER) -> list[str]:
  """Renders poses [N, 4, 4] into a folder; returns the names."""
  folder.mkdir(parents=True, exist_ok=True)
  names = [f"view_{row:03d}.png" for row in range(len(poses))]
  for name, pose in zip(names, poses, strict=True):
    cv2.imwrite(str(folder / name), render(pose, surfaces=surfaces))
  return names


def write_transforms(folder: Path, poses: np.ndarray, camera: Camera, **extra) -> list[str]:
  """Writes pictures and a transforms.json, as nerfstudio does; returns the pictures' names."""
  names = write_images(folder / "images", poses)
  write_frames(folder, [f"images/{name}" for name in names], poses, camera, **extra)
  return names


def write_frames(folder: Path, files, poses: np.ndarray, camera: Camera, **extra) -> None:
  """Writes the transforms.json of pictures that are there, of poses [N, 4, 4] in OpenCV's axes."""
  lens = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
  lens |= {name: getattr(camera, name) for name in ("cx", "cy", "k1", "k2", "p1", "p2")}
  flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
  frames = [
    {"file_path": file, "transform_matrix": (pose @ flip).tolist()}
    for file, pose in zip(files, poses, strict=True)
  ]
  about = {**lens, "camera_model": "OPENCV", "frames": frames, **extra}
  (folder / "transforms.json").write_text(json.dumps(about))


def write_video(
  path: Path, frames: list[np.ndarray], *, codec: str = "libx264", rotation: int = 0
) -> None:
  """Encodes BGR frames [H, W, 3] at 10 frames a second, with rotation metadata in degrees."""
  height, width = frames[0].shape[:2]
  with av.open(str(path), "w") as container:
    stream = container.add_stream(codec, rate=10)
    stream.width, stream.height = width, height
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    if rotation:
      stream.set_display_rotation(rotation)
    for frame in frames:
      container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
    container.mux(stream.encode())
