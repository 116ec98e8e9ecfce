"""Evaluation protocols of the paper, as data: which episodes are run, in which order.

Paper, sections "Navigation and obstacle avoidance results" and "Ball pushing results", and the
appendix table on the camera's gain. A protocol is a tuple of trials; a trial holds where everything
starts. The paper gives the numbers of positions and orientations but not the positions themselves:
navigation trials name them by index, and `scene_starts` draws positions of a scene from its free
space with a fixed seed, so that they are the same for every policy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

GAINS = (128, 90, 50, 10, 1)  # Logitech C920 gain settings, paper, table of the gain ablation
DEFAULT_GAIN = 50  # paper: "50 is the default value used in the navigation experiments"
TRIALS_PER_GAIN = 5
NUM_GOALS, NUM_POSITIONS, NUM_ORIENTATIONS, NUM_TRIALS = 3, 3, 3, 2
WORKSPACE_SIZE = 3.0  # m, ball pushing, paper
CELL_SIZE = 1.0  # m, the target square; the workspace is 3 x 3 cells
TARGET_CELL = (1, 1)  # the corner, in cells from the centre cell: +x, +y
BALL_TIME_LIMIT = 60.0  # s, paper
WALL_SPREAD = 0.1  # m; chosen for the paper's "near the center" of the cell
START_SEED = 20221010  # chosen: fixed, so that every evaluation has the same starts
START_ROOM = 0.15  # m around a start beyond what the robot needs to stand: as at the scene's goals
MIN_GOAL_DISTANCE = 1.0  # m between a start and every goal, where the scene has places; chosen
_START_GRID = 0.1  # m between the candidates of starts; chosen: finer than the robot is wide
_START_ROOM_STEP = (
  0.05  # m by which the room is reduced where the scene has too few; chosen: a cell
)


class NavigationTrial(NamedTuple):
  """One episode of navigation."""

  goal: int  # index into the scene's goals, 0 to 2
  position: int  # index of the start position, 0 to 2
  yaw: float  # heading of the robot in the world, rad
  trial: int  # repetition, 0 or 1
  camera_gain: float = 1.0  # ratio to the default gain
  seed: int = 0  # of the episode's randomisation


class BallTrial(NamedTuple):
  """One episode of ball pushing. Positions are relative to the workspace's centre."""

  setting: str  # "center" or "wall"
  robot_xy: tuple[float, float]  # m
  robot_yaw: float  # rad
  ball_xy: tuple[float, float]  # m
  trial: int
  seed: int = 0


def _orientations(count: int) -> list[float]:
  return [2 * np.pi * index / count for index in range(count)]


def navigation() -> tuple[NavigationTrial, ...]:
  """Returns the 54 trials: 3 goals x 3 positions x 3 orientations x 2 trials."""
  trials: list[NavigationTrial] = []
  for goal in range(NUM_GOALS):
    for position in range(NUM_POSITIONS):
      for yaw in _orientations(NUM_ORIENTATIONS):
        for trial in range(NUM_TRIALS):
          trials.append(NavigationTrial(goal, position, yaw, trial, seed=len(trials)))
  return tuple(trials)


def camera_gain() -> tuple[NavigationTrial, ...]:
  """Returns the 25 trials of the gain ablation: 5 gains x 5 trials, one goal, one start pose."""
  trials: list[NavigationTrial] = []
  for gain in GAINS:
    for trial in range(TRIALS_PER_GAIN):
      ratio = gain / DEFAULT_GAIN
      trials.append(NavigationTrial(0, 0, 0.0, trial, camera_gain=ratio, seed=trial))
  return tuple(trials)


def _outer_cells() -> list[tuple[int, int]]:
  return [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def ball_center() -> tuple[BallTrial, ...]:
  """Returns the 32 Center trials: ball in the centre cell, robot in each of 8 cells, 4 headings."""
  trials: list[BallTrial] = []
  for i, j in _outer_cells():
    for yaw in _orientations(4):
      xy = (i * CELL_SIZE, j * CELL_SIZE)
      trials.append(BallTrial("center", xy, yaw, (0.0, 0.0), 0, seed=len(trials)))
  return tuple(trials)


def ball_wall() -> tuple[BallTrial, ...]:
  """Returns the 14 Wall trials: robot in the centre, facing the target; ball near a wall cell.

  The ball starts within `WALL_SPREAD` of the centre of each of the 7 outer cells other than the
  target, twice.
  """
  rng = np.random.default_rng(START_SEED)
  yaw = float(np.arctan2(TARGET_CELL[1], TARGET_CELL[0]))
  trials: list[BallTrial] = []
  for cell in _outer_cells():
    if cell == TARGET_CELL:
      continue
    for trial in range(2):
      dx, dy = rng.uniform(-WALL_SPREAD, WALL_SPREAD, 2)
      xy = (cell[0] * CELL_SIZE + float(dx), cell[1] * CELL_SIZE + float(dy))
      trials.append(BallTrial("wall", (0.0, 0.0), yaw, xy, trial, seed=100 + len(trials)))
  return tuple(trials)


def ball() -> tuple[BallTrial, ...]:
  """Returns the 46 trials of ball pushing, Center before Wall."""
  return (*ball_center(), *ball_wall())


NAVIGATION, BALL, GAIN = "navigation", "ball", "gain"
PROTOCOLS: dict[str, Callable[[], tuple[NavigationTrial, ...] | tuple[BallTrial, ...]]] = {
  NAVIGATION: navigation,
  BALL: ball,
  GAIN: camera_gain,
}
"""Trials by the name of an evaluation: the paper's tables I, II and V."""


def navigation_starts(free_xy: np.ndarray, goals: np.ndarray) -> np.ndarray:
  """Chooses start positions among places, far from each other and from the goals.

  Greedy farthest points: deterministic for a scene, and spread over it as the paper's three "unique
  initial positions" are.

  Args:
    free_xy: positions [N, 2] at which the robot may stand, m.
    goals: goal positions [G, 2], m.

  Returns:
    Positions [3, 2], m, `MIN_GOAL_DISTANCE` from every goal where the scene has such places.
  """
  count = NUM_POSITIONS
  free = np.asarray(free_xy, np.float64).reshape(-1, 2)
  if len(free) < count:
    raise ValueError(f"Found {len(free)} free positions, expected at least {count}.")
  goals = np.asarray(goals, np.float64).reshape(-1, 2)
  if len(goals):
    to_goal = np.linalg.norm(free[:, None] - goals, axis=-1).min(axis=1)
    far = to_goal >= MIN_GOAL_DISTANCE
    free = free[far] if far.sum() >= count else free[np.argsort(-to_goal, kind="stable")[:count]]
  chosen = [int(np.random.default_rng(START_SEED).integers(len(free)))]
  while len(chosen) < count:
    distance = np.linalg.norm(free[:, None] - free[chosen], axis=-1).min(axis=1)
    chosen.append(int(np.argmax(distance)))
  return free[chosen]


def scene_starts(scene: Any) -> np.ndarray:
  """Returns the start positions of navigation in a scene [3, 2] [m].

  They are chosen where the robot has room to turn and sway, not just where it fits: `START_ROOM`
  around it, or the most that the scene offers.

  Args:
    scene: A bundle: its extent, goals and free space are used.

  Raises:
    ValueError: The robot fits nowhere.
  """
  floor = scene.free_space.grid(scene.extent, _START_GRID)
  free = floor.centres[floor.free]
  goals = np.asarray(scene.goals, np.float64).reshape(-1, 2)
  for room in np.arange(START_ROOM, 0.0, -_START_ROOM_STEP):
    wide = free[scene.free_space.has_room(free, room)]
    far = np.linalg.norm(wide[:, None] - goals, axis=-1).min(axis=1, initial=np.inf)
    if np.count_nonzero(far >= MIN_GOAL_DISTANCE) >= NUM_POSITIONS:
      return navigation_starts(wide, goals)
  return navigation_starts(free, goals)
