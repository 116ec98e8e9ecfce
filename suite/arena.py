"""The room as a composer arena: its convex parts, a floor plane and light, from a scene bundle."""

from pathlib import Path
from typing import Any

import numpy as np
from dm_control import composer

from nerf2real.suite.op3 import op3

FLOOR_FRICTION = (1.0, 0.005, 0.0001)  # sliding, torsional, rolling: MuJoCo's defaults
_FLOOR_COLOR = (0.55, 0.52, 0.48, 1.0)
_MARGIN = 1.0  # m of floor around the scene's extent

# Colours of the convex parts in third-person pictures (Okabe and Ito's palette, softened).
_PART_COLORS = (
  (0.35, 0.55, 0.70, 1.0),
  (0.80, 0.65, 0.35, 1.0),
  (0.35, 0.62, 0.52, 1.0),
  (0.75, 0.58, 0.68, 1.0),
  (0.55, 0.70, 0.82, 1.0),
  (0.78, 0.50, 0.38, 1.0),
)


class SceneArena(composer.Arena):
  """A room as MuJoCo collides with it: z up, metres, floor at z = 0."""

  def _build(
    self, collision_parts: list[Path], extent: tuple[np.ndarray, np.ndarray], *, name: str = "scene"
  ) -> None:
    """Builds the arena.

    Args:
      collision_parts: Convex parts as Wavefront files in the world frame.
      extent: Lower and upper corner of the room [2] or [3] each [m].
      name: Name of the model.
    """
    super()._build(name=name)
    root = self._mjcf_root
    self._lower, self._upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
    if not (self._upper > self._lower).all():
      raise ValueError(
        f"The scene's extent must have lower < upper, found {self._lower} and {self._upper}."
      )
    center, half = (self._lower + self._upper) / 2, (self._upper - self._lower) / 2
    root.compiler.angle = "radian"
    # Composer's arena gives 10 mg at least to every body, also to the frames of attached models.
    root.compiler.set_attributes(boundmass=0, boundinertia=0)
    root.statistic.center = (*center, 0.5)
    root.statistic.extent = float(half.max())
    root.visual.headlight.set_attributes(
      ambient=(0.4, 0.4, 0.4), diffuse=(0.5, 0.5, 0.5), specular=(0.1, 0.1, 0.1)
    )
    root.visual.map.set_attributes(znear=0.005, zfar=20)
    # The depth buffer and shadows in software rendering dominate a picture's time: off.
    root.visual.quality.set_attributes(shadowsize=0, offsamples=0)
    getattr(root.visual, "global").set_attributes(offwidth=1280, offheight=960)
    root.worldbody.add(
      "light",
      name="sky",
      pos=(*center, 3.0),
      dir=(0, 0, -1),
      diffuse=(0.5, 0.5, 0.5),
      castshadow=False,
    )
    self._floor = root.worldbody.add(
      "geom",
      name="floor",
      type="plane",
      pos=(*center, 0.0),
      size=(*(half + _MARGIN), 0.1),
      friction=FLOOR_FRICTION,
      rgba=_FLOOR_COLOR,
      group=op3.FLOOR_GROUP,
    )
    self._parts = []
    for index, path in enumerate(collision_parts):
      mesh = root.asset.add(
        "mesh", name=f"part_{index:03d}", file=str(Path(path).resolve()), inertia="shell"
      )
      self._parts.append(
        root.worldbody.add(
          "geom",
          name=f"part_{index:03d}",
          type="mesh",
          mesh=mesh,
          group=op3.SCENE_GROUP,
          friction=FLOOR_FRICTION,
          rgba=_PART_COLORS[index % len(_PART_COLORS)],
        )
      )

  @property
  def floor(self) -> Any:
    """The floor's plane."""
    return self._floor

  @property
  def parts(self) -> list[Any]:
    """The geoms of the room's convex parts."""
    return self._parts

  @property
  def extent(self) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the room's floor [2] each [m]."""
    return self._lower.copy(), self._upper.copy()
