"""Draws docs/pictures/overview.jpg: the built-in room as the robot sees it, four ways (needs EGL).

python docs/make_overview.py
"""

from pathlib import Path

import cv2
import mujoco
import numpy as np

from nerf2real.core import palette
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.pages import pictures
from nerf2real.core.serialization import from_plain
from nerf2real.scenes.builtin import ground_truth, room
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.geometry import collision

_SIZE = (360, 480)  # height, width of a picture
_SUPERSAMPLE = 3
_POSES = (7, 11)  # of the truth's robot poses


def _contact_model(bundle: Bundle) -> mujoco.MjModel:
  """The convex parts in colours, lit from above."""
  spec = collision.spec(collision.read_parts(bundle.folder / "collision"))
  for index, geom in enumerate(spec.geoms):
    geom.rgba = [*(level / 255 for level in palette.rgb(palette.cycle(index))), 1]
    geom.group = 0
    if geom.name == "floor":
      geom.rgba = [0.82, 0.82, 0.80, 1]
  spec.visual.global_.offheight, spec.visual.global_.offwidth = (_SUPERSAMPLE * n for n in _SIZE)
  spec.visual.headlight.ambient = [0.45] * 3
  spec.visual.headlight.diffuse = [0.1] * 3
  spec.worldbody.add_light(pos=[1, -1, 2.3], dir=[-0.3, 0.3, -1], diffuse=[0.6] * 3)
  return spec.compile()


def main() -> None:
  """Writes the picture beside this script."""
  bundle = Bundle.load()
  world_from_truth = from_plain(bundle.figures["room_from_world"], Similarity).inverse()
  unit_from_truth = bundle.world_from_unit.inverse() @ world_from_truth
  renderer = Renderer(Field.load(bundle.field_path), threads=2)
  camera = ground_truth.robot_camera(*_SIZE)
  poses = [ground_truth.robot_poses()[index] for index in _POSES]
  with room.room_eye() as eye:
    true = [room.true_view(camera, pose, eye=eye)[0] for pose in poses]
  with Eye(_contact_model(bundle)) as eye:  # one GL context at a time
    parts = [
      eye.render(camera, world_from_truth.apply_pose(pose), supersample=_SUPERSAMPLE)[0]
      for pose in poses
    ]
  rows = []
  for index, pose in enumerate(poses):
    color, depth = renderer.render(camera, unit_from_truth.apply_pose(pose))
    rows.append(np.hstack([true[index], color, pictures.depth_map(depth), parts[index]]))
  picture = np.vstack(rows)[..., ::-1]
  target = Path(__file__).parent / "pictures" / "overview.jpg"
  cv2.imwrite(str(target), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
  main()
