"""Photographs a drawn room as a person does who looks across it from along its furniture.

Two thirds from the height of eyes, the others from knee height, every third picture upright, each
with an exposure of its own.
"""

from pathlib import Path

import numpy as np

from benchmarks.drawn_rooms import filming
from benchmarks.rooms import stills
from nerf2real.scenes.builtin import camera_path
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.builtin.room import TrueRoom

_SIZE = 1920, 1440  # pixels
_ROUND_S = 60.0  # time of one round: only where along it a picture is taken is used
_NOISE = 2.0  # of 255


def photograph(
  folder: Path, true_room: TrueRoom, eye: Eye, seed: int, *, count: int = 35
) -> np.ndarray:
  """Writes photographs as a phone keeps them.

  Args:
    folder: Receives them.
    true_room: The room.
    eye: Renders it.
    seed: Of places, lens and noise.
    count: How many.

  Returns:
    The poses of the phone's sensor, world_from_camera [count, 4, 4].
  """
  folder.mkdir(parents=True, exist_ok=True)
  random = np.random.default_rng([seed, 5])
  lens = filming.lens(random).resized(*_SIZE)
  millimetres = round(36 * lens.fx / lens.width)
  falloff = filming.light(lens, random.uniform(*filming.CORNERS))
  across = [part for part in filming.rounds(random) if not part.outwards]
  high = round(count * 2 / 3)
  poses = []
  for part, number in zip(across, (high, count - high), strict=True):
    way = filming.walk(true_room, [part], seconds=_ROUND_S)
    held = camera_path.HandHeld(way, random, seconds=_ROUND_S)
    poses.append(held.pose((np.arange(number) + 0.5) * _ROUND_S / number))
  found = np.concatenate(poses)
  for k, pose in enumerate(found):
    upright = k % 3 == 2
    if upright:
      pose[:3, :3] = pose[:3, :3] @ stills.UPRIGHT_FROM_SENSOR
    picture = eye.render(lens, pose, supersample=1)[0] * falloff
    picture = filming.metered(picture) * picture
    picture += _NOISE * random.standard_normal(picture.shape)
    image = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    path = folder / f"IMG_{k:04d}.jpg"
    stills.save(path, image, upright=upright, millimetres=millimetres)
  return found
