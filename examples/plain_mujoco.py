"""A bundle opened with plain MuJoCo: its contact geometry, goals and visual mesh, nothing else.

  python examples/plain_mujoco.py

A bundle is a folder of open formats; scene.json and convex parts (.obj) are all that physics needs.
"""

import json
import pathlib
import sys

import mujoco

from nerf2real.scenes import bundle


def build(folder: pathlib.Path) -> mujoco.MjModel:
  """Returns the room with a ball that falls onto its first goal."""
  scene = json.loads((folder / "scene.json").read_text())
  spec = mujoco.MjSpec()
  spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
  for name in scene["collision_parts"]:
    stem = name.removesuffix(".obj")
    spec.add_mesh(
      name=stem,
      file=str((folder / "collision" / name).resolve()),
      inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(name=stem, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=stem)
  x, y = scene["goals"][0]
  ball = spec.worldbody.add_body(name="ball", pos=[x, y, 1.0])
  ball.add_freejoint()
  ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=0.5)
  return spec.compile()


def main() -> None:
  """Drops the ball for two seconds."""
  folder = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else bundle.Bundle.load(None).folder
  model = build(folder)
  data = mujoco.MjData(model)
  while data.time < 2.0:
    mujoco.mj_step(model, data)
  height = data.body("ball").xpos[2]
  print(f"{model.nmesh} convex parts; the ball lies at a height of {height:.3f} m")


if __name__ == "__main__":
  main()
