"""The room with the robot drawn by MuJoCo: `physics.render` with the bundle's surface mesh.

  python examples/render_room.py --out out/drawn.png

Needs OpenGL without a screen: MUJOCO_GL=egl, which is set here, or MUJOCO_GL=osmesa. The robot's
own camera (`observation["camera"]`) needs none: it sees the radiance field.
"""

import argparse
import os
import pathlib

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported

import cv2
from dm_control import mujoco

from nerf2real import suite


def main() -> None:
  """Draws the robot at its start, from behind."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--scene", help="folder of a bundle; the built-in room if not given")
  parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/drawn.png"))
  arguments = parser.parse_args()
  environment = suite.load(
    "nerf_nav", scene=arguments.scene, image_size=None, surface=True, random=0
  )
  environment.reset()
  state = environment.task.state
  camera = mujoco.MovableCamera(environment.physics, height=480, width=640)
  heading = state.yaw * 57.3
  camera.set_pose(lookat=state.position, distance=1.5, azimuth=heading, elevation=-25)
  arguments.out.parent.mkdir(parents=True, exist_ok=True)
  cv2.imwrite(str(arguments.out), camera.render()[..., ::-1])
  print(f"wrote {arguments.out}")


if __name__ == "__main__":
  main()
