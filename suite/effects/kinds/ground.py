"""Effects of the floor: slope, sliding friction, rolling resistance."""

import mujoco
import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Effect, Kind, Operator, Parameter


def _geoms(binding: Binding, effect: Effect, *, planes: bool) -> list[int]:
  model = binding.model
  if effect.target is not None:
    return [binding.index("geom", effect.target)]
  if not planes:
    return list(range(model.ngeom))
  plane = np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))
  if not len(plane):
    raise ValueError("Found no plane in the model to slope, expected the name of the floor's geom.")
  return [int(index) for index in plane]


class FloorSlope(Operator):
  """The floor is not level: its geom turns by (x, y) about the world's axes, about its origin."""

  def bind(self, binding: Binding) -> None:
    model = binding.model
    for effect in self.effects:
      vector = np.array([self.value(effect, "x"), self.value(effect, "y"), 0.0])
      if not vector.any():
        continue
      for geom in _geoms(binding, effect, planes=True):
        model.geom_quat[geom] = rotations.rotate_quaternion(vector, model.geom_quat[geom])
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


class FloorFriction(Operator):
  """Sliding friction of the floor is `scale` times the declared one.

  MuJoCo takes the larger friction of two touching geoms unless one has priority: a named geom gets
  priority over those that had its own, so that its friction counts. A geom with a higher one, such
  as a ball that resists rolling, keeps its contacts. Without a target, every geom is scaled.
  """

  def bind(self, binding: Binding) -> None:
    model = binding.model
    for effect in self.effects:
      scale = self.value(effect, "scale")
      if scale == 1:
        continue
      geoms = _geoms(binding, effect, planes=False)
      model.geom_friction[geoms, 0] *= scale
      if effect.target is not None:
        model.geom_priority *= 2  # makes room below those with a higher one
        model.geom_priority[geoms] += 1
      listed = np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms)
      model.pair_friction[listed, :2] *= scale


class RollingResistance(Operator):
  """A geom resists rolling: moment up to coefficient * normal force, MuJoCo's rolling friction.

  The geom's contacts become six-dimensional, so that the torsional friction that MuJoCo gives every
  geom (5 mm) acts as well.
  """

  def bind(self, binding: Binding) -> None:
    model = binding.model
    for effect in self.effects:
      coefficient = self.value(effect, "coefficient")
      if coefficient == 0:
        continue
      if effect.target is None:
        raise ValueError("Found a rolling_resistance without a target, expected the rolling geom.")
      geom = binding.index("geom", effect.target)
      model.geom_friction[geom, 2] += coefficient
      model.geom_condim[geom] = 6
      model.geom_priority[geom] = model.geom_priority.max() + 1
      listed = (model.pair_geom1 == geom) | (model.pair_geom2 == geom)
      model.pair_friction[listed, 3:] += coefficient
      model.pair_dim[listed] = 6


KINDS = (
  Kind(
    "floor_slope",
    "the floor is not level",
    "geom",
    "model",
    (
      Parameter("x", "rad", 0.0, -0.1, 0.1, "turn about the world's x axis", of_joint=False),
      Parameter("y", "rad", 0.0, -0.1, 0.1, "turn about the world's y axis", of_joint=False),
    ),
    FloorSlope,
  ),
  Kind(
    "floor_friction",
    "the floor is more or less slippery than declared",
    "geom",
    "model",
    (Parameter("scale", "1", 1.0, 0.2, 2.0, "true over declared friction", minimum=0.0),),
    FloorFriction,
  ),
  Kind(
    "rolling_resistance",
    "an object resists rolling",
    "geom",
    "model",
    (Parameter("coefficient", "m", 0.0, 0.0, 0.02, "moment per normal force", minimum=0.0),),
    RollingResistance,
  ),
)
