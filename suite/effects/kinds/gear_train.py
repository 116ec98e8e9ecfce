"""Motors and links on elastic gears with play, through one step of the simulator, compiled.

A motor is a mass of its own. Teeth touch at either end of the gap; there they push like a damped
spring and never pull. That is far quicker than a simulator's step, so a step is taken in parts, in
which a link is expected to accelerate as it did before, and by what the gear passes on.

Source: the physical model of Nordin and Gutman 2002, Controlling mechanical systems with backlash,
section 2 (an inertia-free shaft with stiffness and damping behind a gap).

Shapes: J joints.
"""

import math

import numba
import numpy as np

Array = np.ndarray

PART = 2.5e-4
"""s, the longest part of a step; ours."""
_PARTS_A_RADIAN = 4.0  # of the contact's oscillation; ours


@numba.njit(cache=True, nogil=True, fastmath=False)
def parts(step: float, stiffness: float, damping: float, mobility: float) -> int:
  """Returns in how many parts a step [s] is taken so that the contact stays stable.

  Args:
    step: s.
    stiffness: of the contact, N m/rad.
    damping: of the contact, N m s/rad.
    mobility: of motor and link together, 1/(kg m^2).
  """
  rate = max(_PARTS_A_RADIAN * math.sqrt(stiffness * mobility), 2.0 * damping * mobility)
  return max(math.ceil(step / PART), math.ceil(step * rate))


@numba.njit(cache=True, nogil=True, fastmath=False)
def _teeth(offset: float, speed: float, half: float, stiffness: float, damping: float) -> float:
  """Returns the torque that the teeth pass on to the link, of offset and its rate."""
  if offset > half:
    return max(stiffness * (offset - half) + damping * speed, 0.0)
  if offset < -half:
    return min(stiffness * (offset + half) + damping * speed, 0.0)
  return 0.0


@numba.njit(cache=True, nogil=True, fastmath=False)
def _moved(speed: float, grip: float, torque: float, resistance: float, friction: float) -> float:
  """Returns a motor's speed after a part of a step; grip: that part over its inertia."""
  slowing = 1.0 / (1.0 + grip * resistance)
  speed = (speed + grip * torque) * slowing
  most = grip * friction * slowing
  return speed - min(max(speed, -most), most)


@numba.njit(cache=True, nogil=True, fastmath=False)
def advance(
  offset: float,
  motor_speed: float,
  link_speed: float,
  link_acceleration: float,
  torque: float,
  resistance: float,
  friction: float,
  motor: float,
  link: float,
  half: float,
  stiffness: float,
  damping: float,
  step: float,
) -> tuple[float, float, float]:
  """Returns offset, motor speed and the mean torque on the link of one joint after a step.

  Args:
    offset: motor position minus link position, rad.
    motor_speed: rad/s.
    link_speed: rad/s.
    link_acceleration: rad/s^2 that all but the gear give to the link.
    torque: on the motor, N m, without what depends on its speed.
    resistance: N m s/rad on the motor, damping and back-EMF.
    friction: dry, on the motor, N m.
    motor: inertia of the motor, kg m^2 at the output.
    link: inertia of the link, kg m^2.
    half: half the gap, rad.
    stiffness: of the contact, N m/rad.
    damping: of the contact, N m s/rad.
    step: s.
  """
  count = parts(step, stiffness, damping, 1.0 / motor + 1.0 / link)
  part = step / count
  grip = part / motor
  total = 0.0
  for _ in range(count):
    gear = _teeth(offset, motor_speed - link_speed, half, stiffness, damping)
    motor_speed = _moved(motor_speed, grip, torque - gear, resistance, friction)
    link_speed += part * (link_acceleration + gear / link)
    offset += part * (motor_speed - link_speed)
    total += gear
  return offset, motor_speed, total / count


@numba.njit(cache=True, nogil=True, fastmath=False)
def advance_joints(
  offset: Array,
  motor_speed: Array,
  link_speed: Array,
  link_acceleration: Array,
  torque: Array,
  resistance: Array,
  friction: Array,
  motor: Array,
  mobility: Array,
  half: Array,
  stiffness: Array,
  damping: Array,
  step: float,
  passed: Array,
) -> None:
  """Advances joints of one machine, which feel each other's gears: see `advance`.

  Args:
    offset: [J], changed.
    motor_speed: [J], changed.
    link_speed: [J].
    link_acceleration: [J].
    torque: [J].
    resistance: [J].
    friction: [J].
    motor: [J].
    mobility: [J, J] acceleration of each link by torque on each, 1/(kg m^2).
    half: [J].
    stiffness: [J].
    damping: [J].
    step: s.
    passed: [J] mean torques on the links, written.
  """
  joints = offset.size
  count = 1
  for j in range(joints):
    reach = 1.0 / motor[j] + np.abs(mobility[j]).sum()
    count = max(count, parts(step, stiffness[j], damping[j], reach))
  part = step / count
  speed = link_speed.copy()
  gear = np.zeros(joints)
  passed[:] = 0.0
  for _ in range(count):
    for j in range(joints):
      apart = motor_speed[j] - speed[j]
      gear[j] = _teeth(offset[j], apart, half[j], stiffness[j], damping[j])
      drive = torque[j] - gear[j]
      motor_speed[j] = _moved(motor_speed[j], part / motor[j], drive, resistance[j], friction[j])
      passed[j] += gear[j] / count
    for j in range(joints):
      pushed = link_acceleration[j]
      for other in range(joints):
        pushed += mobility[j, other] * gear[other]
      speed[j] += part * pushed
      offset[j] += part * (motor_speed[j] - speed[j])
