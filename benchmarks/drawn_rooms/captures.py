"""Captures of a drawn room: a film, photographs, or the film as a depth camera records it.

What is there is kept.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import av
import cv2
import numpy as np

from benchmarks.drawn_rooms import filming, layout, photographs
from benchmarks.rooms import rgbd
from nerf2real.core.files import atomic_path
from nerf2real.scenes.builtin import ground_truth
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.builtin.room import TrueRoom

_FILM = "film.mp4"
_QUICK = [cv2.IMWRITE_PNG_COMPRESSION, 1]

Kind = Literal["film", "photographs", "depth"]


def draw(seed: int) -> layout.Layout:
  """Draws a seed's room."""
  return layout.draw(np.random.default_rng([seed, 1]))


def film(folder: Path, true_room: TrueRoom, seed: int) -> Mapping[str, np.ndarray]:
  """Films a room into a folder.

  Returns:
    What is known: the pictures' poses `film` [N, 4, 4], their `rate` [1/s], what a robot sees.
  """
  folder.mkdir(parents=True, exist_ok=True)
  truth = folder / "truth.npz"
  if not ((folder / _FILM).exists() and truth.exists()):
    poses = ground_truth.robot_poses(seed=seed, true_room=true_room)
    with filming.seen(true_room, seed) as eye:
      arrays = ground_truth.robot_views(poses, eye)
      with atomic_path(folder / _FILM) as partial:
        taken, rate = filming.film(partial, true_room, eye, seed)
    with atomic_path(truth) as partial:
      np.savez_compressed(partial, film=taken, rate=rate, **arrays)  # type: ignore[arg-type]
  return np.load(truth)


def captured(folder: Path, true_room: TrueRoom, seed: int, kind: Kind) -> tuple[Path, np.ndarray]:
  """Captures a room into a folder.

  Returns:
    The capture, and the true poses [N, 4, 4] of its pictures by number.
  """
  folder.mkdir(parents=True, exist_ok=True)
  if kind == "film":
    poses = film(folder, true_room, seed)["film"]
    return folder / _FILM, poses
  poses_file = folder / f"{kind}.npy"
  if not poses_file.exists():
    known = film(folder, true_room, seed) if kind == "depth" else {}
    with filming.seen(true_room, seed) as eye:
      if kind == "photographs":
        poses = photographs.photograph(folder / kind, true_room, eye, seed)
      else:
        poses = known["film"]
        _sense(folder / kind, folder / _FILM, poses, float(known["rate"]), eye, seed)
    with atomic_path(poses_file) as partial:
      np.save(partial, poses)
  return folder / kind, np.load(poses_file)


def _sense(folder: Path, video: Path, poses: np.ndarray, rate: float, eye: Eye, seed: int) -> None:
  """Writes a film as a hand-held depth camera records it, in TUM's layout."""
  lens = filming.lens(np.random.default_rng([seed, 4]))
  random = np.random.default_rng([seed, 6])
  for name in ("rgb", "depth"):
    (folder / name).mkdir(parents=True, exist_ok=True)
  with av.open(str(video)) as container:
    for k, (pose, frame) in enumerate(zip(poses, container.decode(video=0), strict=True)):
      depth = rgbd.sensed(eye.render(lens, pose, supersample=1)[1], random)
      for name, content in (
        ("rgb", frame.to_ndarray(format="bgr24")),
        ("depth", np.rint(depth / rgbd.TUM_UNIT).astype(np.uint16)),
      ):
        cv2.imwrite(str(folder / name / f"{k:06d}.png"), content, _QUICK)
  rgbd.write_lists(folder, rgbd.tracked(poses, random, rate=rate), lens, rate=rate)
