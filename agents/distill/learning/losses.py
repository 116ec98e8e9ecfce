"""Losses of a student: its actions, its pose and the teacher's command; pure functions on arrays.

Shape letters: A action; leading axes are any.
"""

import jax
import jax.numpy as jnp

# Half the picture's width over its distance: 4/3 of the tangent of half of the suite's camera's
# 43.3 degrees.
VIEW_SLOPE = 0.53
POSITION = 2.0  # m that a unit of the pose target stands for: rooms of some metres


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
  """Mean of values [...] with weights [...]; 0 where all weights are."""
  return jnp.sum(weights * values) / jnp.maximum(jnp.sum(weights), 1e-8)


def camera_pose(pose: jax.Array, ball: jax.Array | None) -> jax.Array:
  """Turns robots' headings [..., 3] into those of their cameras, which is what pictures show.

  Args:
    pose: x [m], y [m], yaw of the torso [rad] [..., 3].
    ball: with the head's pan (`dataset.BALL_SIZE`) [..., 3]; None: the head looks straight ahead.
  """
  if ball is None:
    return pose
  return jnp.concatenate([pose[..., :2], pose[..., 2:] + ball[..., 2:]], axis=-1)


def pose_target(pose: jax.Array) -> jax.Array:
  """Maps poses x [m], y [m], yaw [rad] [..., 3] to targets x / 2 m, y / 2 m, cos, sin [..., 4]."""
  yaw = pose[..., 2]
  return jnp.stack(
    [pose[..., 0] / POSITION, pose[..., 1] / POSITION, jnp.cos(yaw), jnp.sin(yaw)], axis=-1
  )


def pose_errors(predicted: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Distance [...] [m] and turn [...] [rad] between predicted targets [..., 4] and poses."""
  distance = jnp.linalg.norm(POSITION * predicted[..., :2] - pose[..., :2], axis=-1)
  turn = jnp.arctan2(predicted[..., 3], predicted[..., 2]) - pose[..., 2]
  return distance, jnp.abs(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)))


def pose_loss(predicted: jax.Array, pose: jax.Array) -> jax.Array:
  """Mean absolute error of predicted pose targets [..., 4] at poses [..., 3]: robust to the few
  pictures that do not determine the place."""
  return jnp.mean(jnp.abs(predicted - pose_target(pose)))


def ball_target(ball: jax.Array) -> jax.Array:
  """Maps balls [..., 3] (`dataset.BALL_SIZE`) to targets ahead / 2 m, left / 2 m [..., 2]."""
  return ball[..., :2] / POSITION


def ball_target_of_picture(ball: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Maps balls [..., 3] to what a picture shows: targets [..., 2] seen from the head's pan, and
  weights [...]: 1 where the ball is in view."""
  cosine, sine = jnp.cos(ball[..., 2]), jnp.sin(ball[..., 2])
  ahead = cosine * ball[..., 0] + sine * ball[..., 1]
  left = cosine * ball[..., 1] - sine * ball[..., 0]
  seen = (ahead > 0) & (jnp.abs(left) < VIEW_SLOPE * ahead)
  return jnp.stack([ahead, left], axis=-1) / POSITION, seen.astype(jnp.float32)


def ball_loss(predicted: jax.Array, target: jax.Array, weights: jax.Array) -> jax.Array:
  """Mean absolute error of predicted ball targets [..., 2] with weights [...]."""
  return weighted_mean(jnp.mean(jnp.abs(predicted - target), axis=-1), weights)


def action_loss(
  actions: jax.Array, labels: jax.Array, *, spread: jax.Array, weights: jax.Array
) -> jax.Array:
  """Huber loss of actions [..., A] in units of their spread under the teacher [A].

  A joint that moves little while walking, such as the hip's yaw, counts as much as one that moves
  much: turning lives in two of twenty joints.

  Args:
    actions: the student's means.
    labels: the teacher's actions.
    spread: standard deviation of the labels over the data.
    weights: of frames [...]; 0 where a label counts nothing.
  """
  error = (actions - labels) / spread
  huber = jnp.where(jnp.abs(error) < 1.0, 0.5 * error**2, jnp.abs(error) - 0.5)
  return weighted_mean(jnp.mean(huber, axis=-1), weights)


def command_loss(predicted: jax.Array, command: jax.Array, weights: jax.Array) -> jax.Array:
  """Mean squared error of commands [..., 2]; frames whose teacher has no command (NaN) are left
  out."""
  known = jnp.isfinite(command).all(axis=-1)
  error = jnp.mean((predicted - jnp.nan_to_num(command)) ** 2, axis=-1)
  return weighted_mean(error, weights * known)


def frame_weights(
  command: jax.Array, goal_distance: jax.Array, *, turn_emphasis: float, blind_radius: float
) -> jax.Array:
  """Weights of frames [...] in the action loss: 1 + turn_emphasis |turn|, or 0 near the goal.

  Args:
    command: forward and turn [..., 2]; NaN counts as no turn.
    goal_distance: to the goal [...] [m].
    turn_emphasis: weight that a full turning command adds.
    blind_radius: distance within which labels count nothing [m].
  """
  turn = jnp.abs(jnp.nan_to_num(command[..., 1]))
  return (1.0 + turn_emphasis * turn) * (goal_distance > blind_radius)
