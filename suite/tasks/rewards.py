"""Reward terms of the two tasks, as pure functions.

Byravan et al., NeRF2Real: Sim2real transfer of vision-guided bipedal motion skills using neural
radiance fields (arXiv 2210.04932), appendix "Rewards". Everything is in SI units. Where the printed
formulas and the text of the paper disagree, the choice and the reason are in the docstring.

Shapes: J joints.
"""

from collections.abc import Mapping

import numpy as np

from nerf2real.core.geometry.rotations import shortest_rotation

Array = np.ndarray

MAX_YAW_SPEED = np.pi  # rad/s, paper, r_turn
WALKING_SPEED = 0.3  # m/s, paper, r_speed and r_navigate
SUCCESS_DISTANCE = 0.25  # m, paper, r_navigate_sparse

# Paper, "The full reward we used for training the navigation policies".
NAVIGATION_WEIGHTS: Mapping[str, float] = {
  "turn": 1.0,
  "speed": 0.5,
  "pose": 0.5,
  "navigate_sparse": 1.0,
  "navigate": 0.25,
}
# Paper, "the full reward for training ball pushing policies".
BALL_WEIGHTS: Mapping[str, float] = {"turn": 1.0, "speed": 0.5, "pose": 0.5, "ball": 1.0}

_DOWN = np.array([0.0, 0.0, -1.0])


def gravity_aligned_frame(world_from_torso: Array, gravity: Array = _DOWN) -> Array:
  """Returns world_from_aligned [3, 3]: the torso's frame, turned upright.

  The smallest rotation that takes the torso's -z axis to the direction of gravity, applied to the
  torso's frame (paper, appendix). x is then the robot's forward direction in the horizontal plane,
  y its left, z is up. Every velocity and goal in the rewards is expressed in this frame.

  For a torso exactly upside down the smallest rotation is not unique: the half turn about the
  torso's own x axis is taken, which keeps x.

  Args:
    world_from_torso: rotation matrix [3, 3].
    gravity: direction of gravity in the world [3], of any length.
  """
  rotation = np.asarray(world_from_torso, np.float64)
  down = np.asarray(gravity, np.float64) / np.linalg.norm(gravity)
  start = -rotation[:, 2]
  return shortest_rotation(start, down, half_turn_axis=rotation[:, 0]) @ rotation


def yaw_rate(world_from_torso: Array, angular_velocity: Array, gravity: Array = _DOWN) -> float:
  """Returns the angular velocity [rad/s] of the gravity-aligned frame about the vertical.

  With n the torso's z axis, u the upward vertical and w the torso's angular velocity (all in the
  world), the smallest-rotation frame turns at w.(n + u) / (1 + n.u). For an upright torso that is
  w.u; for a tilted one w.u alone would count the torso's roll and pitch rates wrongly.
  """
  up = -np.asarray(gravity, np.float64) / np.linalg.norm(gravity)
  axis = np.asarray(world_from_torso)[:, 2]
  return float(np.dot(angular_velocity, axis + up) / max(1 + float(axis @ up), 1e-9))


def distance_rate(position: Array, velocity: Array) -> float:
  """Returns the time derivative [m/s] of |position|; |velocity| where position is zero.

  Args:
    position: relative position [2] or [3].
    velocity: its time derivative, same shape.
  """
  distance = float(np.linalg.norm(position))
  if distance < 1e-9:
    return float(np.linalg.norm(velocity))
  return float(np.dot(position, velocity) / distance)


def turn(yaw_speed: float) -> float:
  """r_turn = -1 if |w_yaw| > pi else 0.

  The paper prints w_yaw > pi without the absolute value, but calls it "a constant penalty whenever
  the robot's yaw angular speed is larger than pi": speed has no sign, so |w_yaw| is used.
  """
  return -1.0 if abs(yaw_speed) > MAX_YAW_SPEED else 0.0


def pose(joints: Array, reference: Array, joint_range: Array) -> float:
  """r_pose = -sqrt(mean_i((q_i - ref_i)^2 / range_i^2)).

  The paper prints it without the minus sign and adds it with a positive weight, which would reward
  leaving the pose; its text calls it an "L2 regularization on joint angles towards a default
  standing pose". So it is a penalty here, never positive. Two printed references (hip pitch, hip
  roll) lie outside their printed ranges: the best reachable value is then below 0 on purpose.

  Args:
    joints: joint positions [J], rad.
    reference: the paper's reference poses [J], rad.
    joint_range: upper minus lower limit of the paper's table [J], rad.
  """
  error = (np.asarray(joints) - reference) / joint_range
  return -float(np.sqrt(np.mean(np.square(error))))


def speed(forward_speed: float) -> float:
  """r_speed = (0.3 - |v_x - 0.3|) / 0.3.

  Args:
    forward_speed: x component, in the gravity-aligned frame, of the velocity of the midpoint of
      the feet, m/s.
  """
  return (WALKING_SPEED - abs(forward_speed - WALKING_SPEED)) / WALKING_SPEED


def navigate_sparse(goal: Array) -> float:
  """r_navigate_sparse = 1 if |x_goal| < 0.25 else 0; goal [2] in the gravity-aligned frame, m."""
  return 1.0 if float(np.hypot(goal[0], goal[1])) < SUCCESS_DISTANCE else 0.0


def navigate(feet_velocity: Array, goal: Array) -> float:
  """r_navigate = (0.3 - |v_xy - 0.3 x_goal / |x_goal||) / 0.3.

  At the goal itself the direction is undefined; it then counts as zero (stand still).

  Args:
    feet_velocity: velocity [>= 2] of the midpoint of the feet, gravity-aligned frame, m/s.
    goal: goal position [2] relative to the robot, gravity-aligned frame, m.
  """
  distance = float(np.hypot(goal[0], goal[1]))
  scale = WALKING_SPEED / distance if distance > 1e-9 else 0.0
  error = float(np.hypot(feet_velocity[0] - scale * goal[0], feet_velocity[1] - scale * goal[1]))
  return (WALKING_SPEED - error) / WALKING_SPEED


def rho(distance: float, rate: float) -> float:
  """rho(d, v) = e^(-d^2 - v^2) + (1 - e^(-d^2)) (1 - e^(-min(0, v)^2)), between 0 and 1.

  Near 1 when d is small and constant, or when d is large and falling fast.

  Args:
    distance: d, m.
    rate: v, time derivative of d, m/s.
  """
  near = np.exp(-(distance**2))
  approach = 1 - np.exp(-(min(0.0, rate) ** 2))
  return float(near * np.exp(-(rate**2)) + (1 - near) * approach)


def ball(
  goal_distance: float, goal_rate: float, *, ball_distance: float, ball_rate: float
) -> float:
  """r_ball = rho(d_goal, v_goal) + (1 - rho(d_goal, v_goal)) rho(d_ball, v_ball) / 2.

  Args:
    goal_distance: distance of the ball from the goal, m.
    goal_rate: its time derivative, m/s.
    ball_distance: distance of the robot from the ball, m.
    ball_rate: its time derivative, m/s.
  """
  towards_goal = rho(goal_distance, goal_rate)
  return towards_goal + (1 - towards_goal) * rho(ball_distance, ball_rate) / 2


def combine(terms: Mapping[str, float], weights: Mapping[str, float]) -> dict[str, float]:
  """Returns the terms and `total`, their weighted sum."""
  if set(terms) != set(weights):
    raise ValueError(f"Found the reward terms {sorted(terms)}, expected {sorted(weights)}.")
  return {**terms, "total": sum(weights[name] * float(value) for name, value in terms.items())}


def regularisation(
  yaw_speed: float, forward_speed: float, *, joints: Array, reference: Array, joint_range: Array
) -> dict[str, float]:
  """Returns the terms that both tasks share, unweighted: turn, speed, pose."""
  return {
    "turn": turn(yaw_speed),
    "speed": speed(forward_speed),
    "pose": pose(joints, reference, joint_range),
  }


def navigation_task(
  yaw_speed: float,
  feet_velocity: Array,
  *,
  goal: Array,
  joints: Array,
  reference: Array,
  joint_range: Array,
) -> dict[str, float]:
  """Returns the unweighted terms of the navigation task and their weighted `total`.

  Args:
    yaw_speed: from `yaw_rate`, rad/s.
    feet_velocity: velocity [>= 2] of the midpoint of the feet, gravity-aligned frame, m/s.
    goal: goal position [2] relative to the robot, gravity-aligned frame, m.
    joints: joint positions [J], rad.
    reference: reference pose [J], rad.
    joint_range: upper minus lower limit [J], rad.
  """
  terms = regularisation(
    yaw_speed, float(feet_velocity[0]), joints=joints, reference=reference, joint_range=joint_range
  )
  terms["navigate_sparse"] = navigate_sparse(goal)
  terms["navigate"] = navigate(feet_velocity, goal)
  return combine(terms, NAVIGATION_WEIGHTS)


def ball_task(
  yaw_speed: float,
  feet_velocity: Array,
  *,
  goal_from_ball: Array,
  ball_from_robot: Array,
  ball_velocity: Array,
  robot_velocity: Array,
  joints: Array,
  reference: Array,
  joint_range: Array,
) -> dict[str, float]:
  """Returns the unweighted terms of the ball pushing task and their weighted `total`.

  Distances are in the horizontal plane: the first two entries of every vector are used, and the
  vectors of one call share one frame (the world's, or any that does not turn).

  Args:
    yaw_speed: from `yaw_rate`, rad/s.
    feet_velocity: velocity of the midpoint of the feet, gravity-aligned frame, m/s.
    goal_from_ball: goal position minus ball position [>= 2], m.
    ball_from_robot: ball position minus robot position [>= 2], m.
    ball_velocity: velocity of the ball [>= 2], m/s.
    robot_velocity: velocity of the robot [>= 2], m/s.
    joints: joint positions [J], rad.
    reference: reference pose [J], rad.
    joint_range: upper minus lower limit [J], rad.
  """
  ball_xy, robot_xy = np.asarray(ball_velocity)[:2], np.asarray(robot_velocity)[:2]
  to_goal, to_ball = np.asarray(goal_from_ball)[:2], np.asarray(ball_from_robot)[:2]
  terms = regularisation(
    yaw_speed, float(feet_velocity[0]), joints=joints, reference=reference, joint_range=joint_range
  )
  terms["ball"] = ball(
    float(np.linalg.norm(to_goal)),
    distance_rate(to_goal, -ball_xy),
    ball_distance=float(np.linalg.norm(to_ball)),
    ball_rate=distance_rate(to_ball, ball_xy - robot_xy),
  )
  return combine(terms, BALL_WEIGHTS)
