"""The tasks' names and the lengths of their episodes: data that needs no simulator."""

from nerf2real.suite import protocols

NERF_NAV, BALL_PUSH = "nerf_nav", "ball_push"
TIME_LIMITS = {
  # Chosen: the paper names no limit for navigation; three times its median time to a goal (10.3 s).
  NERF_NAV: 30.0,
  BALL_PUSH: protocols.BALL_TIME_LIMIT,  # paper
}  # s
ALL_TASKS: tuple[str, ...] = tuple(TIME_LIMITS)
