"""What a task's page is made of: surfaces of MuJoCo's geoms, reward terms as bars."""

import html

import mujoco
import trimesh

_BAR_RANGE = 1.5  # a bar's full length is a reward term of this size


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
  """Returns the surface of a box, cylinder, capsule or sphere in its own frame."""
  size = model.geom_size[geom]
  kind = mujoco.mjtGeom(model.geom_type[geom])
  if kind == mujoco.mjtGeom.mjGEOM_BOX:
    return trimesh.creation.box(2 * size)
  if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
    return trimesh.creation.cylinder(size[0], 2 * size[1], sections=24)
  if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
    return trimesh.creation.capsule(2 * size[1], size[0], count=(16, 16))
  if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
    return trimesh.creation.icosphere(3, size[0])
  return None


def bars(terms: dict[str, float]) -> str:
  """Returns the reward terms as bars from the middle, as HTML."""
  rows = []
  for name, value in terms.items():
    share = 50 * min(abs(value) / _BAR_RANGE, 1.0)
    left = 50.0 if value >= 0 else 50.0 - share
    color = "#009E73" if value >= 0 else "#D55E00"
    rows.append(
      f'<div style="display:flex;align-items:center;font-size:12px;margin:3px 12px">'
      f'<span style="width:8.5em">{html.escape(name)}</span>'
      f'<span style="flex:1;position:relative;height:11px;background:#8883">'
      f'<i style="position:absolute;left:{left:.1f}%;width:{share:.1f}%;height:100%;'
      f'background:{color}"></i></span>'
      f'<span style="width:4em;text-align:right">{value:+.2f}</span></div>'
    )
  return "".join(rows)
