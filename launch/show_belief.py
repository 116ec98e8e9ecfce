"""Draws where a policy believes it is: `python launch/show_belief.py runs/nav/policy/newest`.

Runs an episode of the policy's environment with its mean action and draws, at moments spread over
the episode, what the robot sees beside the belief over the room's free floor: white X where it is,
green triangle the goal. Prints the distance between the belief's mean and the truth.
"""

import argparse
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disabled")

import cv2
import numpy as np

from nerf2real.agents.dmpo import belief_plot
from nerf2real.agents.dmpo.acting import task_of
from nerf2real.agents.dmpo.export import ExportedPolicy, load_policy
from nerf2real.agents.dmpo.specs import planar_pose
from nerf2real.agents.processes.environments import make_environment

_CELL = 0.05  # m
_FREE, _OTHER = 235, 60  # grey levels of the floor where the robot fits, and of all else
_COLUMNS = 4  # moments in a row of the picture


def floor_map(task: Any, extent: belief_plot.Extent) -> np.ndarray:
  """The free floor from above over an extent, uint8 [rows, columns, 3]."""
  x_from, x_to, y_from, y_to = extent
  x = np.arange(x_from + _CELL / 2, x_to, _CELL)
  y = np.arange(y_from + _CELL / 2, y_to, _CELL)[::-1]
  grid = np.stack(np.meshgrid(x, y), axis=-1)
  free = np.asarray(task.scene.free_space.is_reachable(grid.reshape(-1, 2)))
  grey = np.where(free.reshape(grid.shape[:2]), _FREE, _OTHER).astype(np.uint8)
  return np.repeat(grey[..., None], 3, axis=-1)


def run_episode(
  loaded: ExportedPolicy, environment: Any, *, moments: int, max_steps: int
) -> tuple[list[np.ndarray], list[float]]:
  """Runs an episode; returns a picture of each moment and the belief's errors at all steps [m]."""
  task, layout, policy = task_of(environment), loaded.layout, loaded.policy
  if layout.pose_columns is None or not policy.has_belief:
    raise ValueError("The policy has no belief: it needs pictures and the true pose in training.")
  lower, upper = (np.asarray(corner, float)[:2] for corner in task.scene.extent)
  extent = (lower[0], upper[0], lower[1], upper[1])
  background = floor_map(task, extent)
  timestep, state = environment.reset(), policy.initial_state()
  goal = getattr(task, "goal", None)
  frames: list[np.ndarray] = []
  errors: list[float] = []
  while not timestep.last() and len(errors) < max_steps:
    flat = layout.flatten(timestep.observation)
    step = policy.step(flat.image, flat.state, state)
    state = step.state
    truth = planar_pose(flat.privileged, layout.pose_columns)[:2]
    errors.append(float(np.linalg.norm(policy.believed_position(step.embedding) - truth)))
    density = belief_plot.position_density(
      *policy.belief(step.embedding), extent=extent, cell=_CELL
    )
    heat = belief_plot.draw_heat_map(
      density, extent=extent, truth=truth, target=goal, background=background, pixels_per_cell=4
    )
    frames.append(_beside(flat.image, heat, f"{len(errors) - 1}: {errors[-1]:.2f} m"))
    timestep = environment.step(step.mean)
  chosen = np.unique(np.linspace(0, len(frames) - 1, moments).round().astype(int))
  return [frames[i] for i in chosen], errors


def _beside(image: np.ndarray | None, heat: np.ndarray, text: str) -> np.ndarray:
  assert image is not None
  width = heat.shape[1]
  seen = cv2.resize(
    image, (width, round(width * image.shape[0] / image.shape[1])), interpolation=cv2.INTER_NEAREST
  )
  picture = np.concatenate([np.asarray(seen), heat])
  cv2.putText(
    picture, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
  )
  return np.pad(picture, ((2, 2), (2, 2), (0, 0)), constant_values=255)


def montage(frames: list[np.ndarray]) -> np.ndarray:
  """Puts pictures of one size into rows."""
  frames = frames + [np.full_like(frames[0], 255)] * (-len(frames) % _COLUMNS)
  rows = [np.concatenate(frames[i : i + _COLUMNS], axis=1) for i in range(0, len(frames), _COLUMNS)]
  return np.concatenate(rows)


def main() -> int:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("policy", type=Path, help="folder of an exported policy")
  parser.add_argument("--env", help="another environment than the one it was trained on")
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--moments", type=int, default=8)
  parser.add_argument("--max-steps", type=int, default=1200, help="longest episode [steps]")
  parser.add_argument("--out", type=Path, default=Path("out/belief.png"))
  arguments = parser.parse_args()
  try:
    loaded = load_policy(arguments.policy)
    environment = make_environment(
      arguments.env or loaded.environment, seed=arguments.seed, history=loaded.history
    )
    frames, errors = run_episode(
      loaded, environment, moments=arguments.moments, max_steps=arguments.max_steps
    )
  except ValueError as error:
    print(f"error: {error}", file=sys.stderr)
    return 2
  arguments.out.parent.mkdir(parents=True, exist_ok=True)
  cv2.imwrite(os.fspath(arguments.out), montage(frames)[..., ::-1])
  print(
    f"{len(errors)} steps, mean distance of the belief from the truth {np.mean(errors):.2f} m, "
    f"at the end {errors[-1]:.2f} m: {arguments.out}"
  )
  return 0


if __name__ == "__main__":
  sys.exit(main())
