"""The ball of the ball pushing task: an orange sphere on the floor."""

from typing import Any

from dm_control import composer, mjcf

from nerf2real.suite.op3 import op3
from nerf2real.suite.randomisation.draws import BALL_MASS, BALL_RADIUS

COLOR = (0.86, 0.42, 0.10, 1.0)  # "a simple orange ball" (paper, "Tasks")
# Sliding, torsional, rolling [m] friction. Chosen: rubber on a floor; rolling over radius is 0.8 %.
FRICTION = (0.8, 0.005, 0.001)
_ROLLING = 6  # MuJoCo contact dimension with torsional and rolling friction


class Ball(composer.Entity):
  """A basketball: 0.651 kg, 12 cm radius, its mass in its shell."""

  def _build(self, name: str = "ball") -> None:
    self._root = mjcf.RootElement(model=name)
    self._geom = self._root.worldbody.add(
      "geom",
      name="geom",
      type="sphere",
      size=(BALL_RADIUS,),
      mass=BALL_MASS,
      shellinertia=True,
      rgba=COLOR,
      friction=FRICTION,
      condim=_ROLLING,
      priority=1,
      group=op3.VISIBLE_GROUP,
    )

  @property
  def mjcf_model(self) -> Any:
    return self._root

  @property
  def geom(self) -> Any:
    """The ball's sphere."""
    return self._geom
