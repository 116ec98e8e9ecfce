"""The tasks' names, protocols and lengths of episodes: data that needs no simulator."""

from nerf2real.suite import protocols

NERF_NAV, BALL_PUSH = "nerf_nav", "ball_push"
TIME_LIMITS = {
  # Chosen: the paper names no limit for navigation; three times its median time to a goal (10.3 s).
  NERF_NAV: 30.0,
  BALL_PUSH: protocols.BALL_TIME_LIMIT,  # paper
}  # s
PROTOCOLS = {
  NERF_NAV: (protocols.NAVIGATION, protocols.GAIN),
  BALL_PUSH: (protocols.BALL,),
}
"""Evaluation protocols of a task; policies are evaluated by the first while they learn."""
ALL_TASKS: tuple[str, ...] = tuple(TIME_LIMITS)
