"""Any MJCF robot in a reconstructed room, with a camera that sees the room's radiance field.

  python examples/any_robot.py --seconds 2

Here a ball on two wheels; `ROBOT` may be the text of any MJCF file with a camera. Physics is plain
MuJoCo, the room's contact geometry comes from the bundle, and the camera's picture from its field,
with the robot's own moving parts composited by depth.
"""

import argparse
import pathlib

import cv2
import mujoco
import numpy as np
from dm_control import mjcf

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.bundle import Bundle
from nerf2real.suite.arena import SceneArena
from nerf2real.suite.loading import load_renderer
from nerf2real.suite.op3 import op3
from nerf2real.suite.sensors.camera import RobotCamera

ROBOT = f"""
<mujoco model="cart">
  <worldbody>
    <body name="base">
      <geom name="ball" type="sphere" size="0.06" mass="0.5" group="{op3.VISIBLE_GROUP}"
            friction="0.01" rgba="0.2 0.3 0.6 1"/>
      <camera name="eye" pos="0.08 0 0.12" xyaxes="0 -1 0 0.2 0 1"/>
      <body name="left" pos="0 0.08 -0.01">
        <joint name="left" axis="0 1 0" damping="0.001"/>
        <geom type="cylinder" size="0.05 0.01" zaxis="0 1 0" mass="0.05"
              group="{op3.VISIBLE_GROUP}"/>
      </body>
      <body name="right" pos="0 -0.08 -0.01">
        <joint name="right" axis="0 1 0" damping="0.001"/>
        <geom type="cylinder" size="0.05 0.01" zaxis="0 1 0" mass="0.05"
              group="{op3.VISIBLE_GROUP}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="left" kv="0.05"/>
    <velocity joint="right" kv="0.05"/>
  </actuator>
</mujoco>
"""  # the geoms' group is the one that cameras see


def main() -> None:
  """Drives through the room and writes what the robot's camera saw last."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--bundle", type=pathlib.Path, help="folder; the built-in room if not given")
  parser.add_argument("--seconds", type=float, default=2.0)
  parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/any_robot.png"))
  arguments = parser.parse_args()

  bundle = Bundle.load(arguments.bundle)
  arena = SceneArena(bundle.collision_parts, bundle.extent)
  x, y, _ = bundle.free_space.sample(np.random.default_rng(0), 1)[0]
  robot = mjcf.from_xml_string(ROBOT)
  frame = arena.mjcf_model.attach(robot)
  frame.add("freejoint")
  physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
  model, data = physics.model.ptr, physics.data.ptr
  data.qpos[:3] = x, y, 0.06

  lens = Camera.from_vertical_fov(np.deg2rad(60), width=160, height=120)
  camera = RobotCamera(load_renderer(bundle), lens, world_from_unit=bundle.world_from_unit)
  camera.bind(model, model.camera("cart/eye").id)

  data.ctrl[:] = 6.0, 5.0  # rad/s: forward, in a wide curve
  for _ in range(round(arguments.seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)
  mujoco.mj_forward(model, data)
  picture = camera.render(data)
  arguments.out.parent.mkdir(parents=True, exist_ok=True)
  cv2.imwrite(str(arguments.out), picture[..., ::-1])
  moved = float(np.hypot(*(data.qpos[:2] - (x, y))))
  print(f"moved {moved:.2f} m; wrote {arguments.out}, {picture.shape[1]} x {picture.shape[0]}")


if __name__ == "__main__":
  main()
