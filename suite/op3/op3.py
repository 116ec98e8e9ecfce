"""The OP3 as a composer entity, built from its link table with geoms of our own.

Masses, centres of mass, inertias, frames and joint axes are exactly the table's (`links.csv`); the
geoms are plain boxes and cylinders of an OP3's proportions: they collide and they are what the
robot's camera sees of its own arms and legs, and carry no mass.
"""

from typing import Any

import numpy as np
from dm_control import composer, mjcf

from nerf2real.suite.op3 import constants

# MuJoCo geom groups, shared by everything in `suite`.
VISIBLE_GROUP = 0  # dynamic geoms that the robot's camera sees
HEAD_GROUP = 1  # carried by the head, so invisible to the camera that sits inside them
FLOOR_GROUP = 2
SCENE_GROUP = 3  # the room's convex parts

_DARK = (0.13, 0.13, 0.14, 1.0)  # servos and brackets
_LIGHT = (0.62, 0.64, 0.66, 1.0)  # aluminium frames
_SHELL = (0.22, 0.24, 0.28, 1.0)  # torso and head covers

# Link (without l_ or r_): list of (type, half sizes, position, colour) in the link's frame [m], for
# the left side; positions change the sign of y on the right. Chosen: plausible OP3 proportions.
_GEOMS: dict[str, list[tuple[str, tuple[float, ...], tuple[float, float, float], tuple]]] = {
  "body_link": [
    ("box", (0.040, 0.048, 0.058), (-0.012, 0.0, 0.066), _SHELL),
    ("box", (0.012, 0.034, 0.030), (0.034, 0.0, 0.080), _LIGHT),
    ("box", (0.025, 0.046, 0.009), (-0.012, 0.0, -0.001), _LIGHT),
  ],
  "head_pan_link": [("cylinder", (0.011, 0.016), (0.0, 0.0, 0.010), _DARK)],
  "head_tilt_link": [("box", (0.030, 0.036, 0.032), (-0.008, -0.019, 0.032), _SHELL)],
  "sho_pitch_link": [("box", (0.011, 0.010, 0.011), (0.0, 0.010, 0.0), _DARK)],
  "sho_roll_link": [("box", (0.017, 0.033, 0.020), (-0.018, 0.042, 0.0), _DARK)],
  "el_link": [
    ("box", (0.014, 0.036, 0.016), (-0.019, 0.040, 0.002), _LIGHT),
    ("box", (0.010, 0.022, 0.014), (-0.019, 0.098, 0.003), _DARK),
  ],
  "hip_yaw_link": [("cylinder", (0.011, 0.006), (0.0, 0.0, -0.010), _DARK)],
  "hip_roll_link": [("box", (0.030, 0.016, 0.019), (0.004, 0.0, -0.012), _DARK)],
  "hip_pitch_link": [("box", (0.017, 0.016, 0.048), (0.0, -0.019, -0.054), _LIGHT)],
  "knee_link": [("box", (0.013, 0.015, 0.048), (0.0, -0.021, -0.053), _LIGHT)],
  "ank_pitch_link": [("box", (0.028, 0.016, 0.019), (-0.020, -0.019, 0.012), _DARK)],
  "ank_roll_link": [("box", size, position, _DARK) for size, position in constants.FOOT_BOXES],
}


class OP3(composer.Robot):
  """A Robotis OP3 with 20 P-only position servos, a head camera and an IMU in the torso."""

  def _build(self, name: str = "op3", *, head_pan_limit: float | None = None) -> None:
    """Builds the model.

    Args:
      name: Name of the model, the prefix of its elements in an arena.
      head_pan_limit: Limit of the head pan's target, +- rad; None is the paper's table.
    """
    self._root = mjcf.RootElement(model=name)
    self._root.compiler.angle = "radian"
    self._root.compiler.autolimits = True
    self._lower, self._upper = constants.joint_limits(head_pan=head_pan_limit)
    self._bodies: dict[str, Any] = {}
    for link in constants.read_links():
      self._bodies[link.name] = self._add_link(link)
    self._joints = tuple(self._root.find("joint", joint) for joint in constants.JOINT_NAMES)
    self._actuators = tuple(
      self._root.actuator.add(
        "position",
        name=joint.name,
        joint=joint,
        kp=constants.POSITION_GAIN,
        ctrlrange=(lower, upper),
        forcerange=(-constants.TORQUE_LIMIT, constants.TORQUE_LIMIT),
      )
      for joint, lower, upper in zip(self._joints, self._lower, self._upper, strict=True)
    )
    for first, second in constants.EXCLUDED_CONTACTS:
      self._root.contact.add(
        "exclude", name=f"{first}_{second}", body1=self._bodies[first], body2=self._bodies[second]
      )
    self._camera = self._bodies[constants.CAMERA_LINK].add(
      "camera",
      name="head_camera",
      pos=constants.CAMERA_POSITION,
      xyaxes=(0, -1, 0, 0, 0, 1),
      fovy=float(np.rad2deg(constants.CAMERA_VERTICAL_FOV)),
    )
    self._imu = self.torso.add("site", name="imu", pos=constants.IMU_POSITION, size=(0.004,))
    self._imu.group = 4  # hidden in pictures
    self._root.sensor.add("gyro", name="gyroscope", site=self._imu)
    self._root.sensor.add("accelerometer", name="accelerometer", site=self._imu)

  def _add_link(self, link: constants.Link) -> Any:
    """Adds one link with its inertial, joint and geoms; returns the body."""
    if link.parent == "world":
      body = self._root.worldbody.add("body", name=link.name)
    else:
      body = self._bodies[link.parent].add("body", name=link.name, pos=link.position)
    body.add(
      "inertial", mass=link.mass, pos=link.center, quat=link.inertia_quat, diaginertia=link.inertia
    )
    if link.joint != "free":
      body.add(
        "joint",
        name=link.joint,
        type="hinge",
        axis=link.axis,
        damping=constants.JOINT_DAMPING,
        armature=constants.ARMATURE,
        frictionloss=constants.FRICTION_LOSS,
      )
    side = -1.0 if link.name.startswith("r_") else 1.0
    part = link.name[2:] if link.name[:2] in ("l_", "r_") else link.name
    for index, (kind, size, position, color) in enumerate(_GEOMS[part]):
      body.add(
        "geom",
        name=f"{link.name}_{index}",
        type=kind,
        size=size,
        rgba=color,
        mass=0,
        pos=(position[0], side * position[1], position[2]),
        group=HEAD_GROUP if part.startswith("head") else VISIBLE_GROUP,
      )
    return body

  @property
  def mjcf_model(self) -> Any:
    return self._root

  @property
  def actuators(self) -> tuple[Any, ...]:
    """The position servos, in the order of `constants.JOINT_NAMES`."""
    return self._actuators

  @property
  def joints(self) -> tuple[Any, ...]:
    """The hinges, in the order of `constants.JOINT_NAMES`."""
    return self._joints

  @property
  def torso(self) -> Any:
    """The torso's body."""
    return self._bodies[constants.TORSO_LINK]

  @property
  def feet(self) -> tuple[Any, Any]:
    """The bodies of the left and the right foot."""
    left, right = constants.FOOT_LINKS
    return self._bodies[left], self._bodies[right]

  @property
  def bodies(self) -> dict[str, Any]:
    """All links by name."""
    return self._bodies

  @property
  def camera(self) -> Any:
    """The head camera (MuJoCo's axes: x right, y up, looking along -z)."""
    return self._camera

  @property
  def imu(self) -> Any:
    """The site where gyroscope and accelerometer sit."""
    return self._imu

  @property
  def control_limits(self) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper position targets [20] [rad]."""
    return self._lower.copy(), self._upper.copy()
