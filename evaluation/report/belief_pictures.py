"""Pictures of what a policy with a belief sees, and of where it expects to be, over an episode."""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from nerf2real.agents.dmpo.policy import belief_plot
from nerf2real.agents.dmpo.policy.acting import Agent, task_of
from nerf2real.agents.dmpo.policy.export import ExportedPolicy, load_policy
from nerf2real.agents.dmpo.specs import planar_pose
from nerf2real.agents.environments.loading import make_environment
from nerf2real.scenes.geometry import floor_picture

_SCALE = 80  # pixel/m
_COLUMNS = 4  # moments in a row of the picture


def run_episode(
  loaded: ExportedPolicy, environment: Any, *, moments: int, max_steps: int
) -> tuple[list[np.ndarray], list[float]]:
  """Runs an episode; returns a picture of each moment and the belief's errors at all steps [m]."""
  task, layout, policy = task_of(environment), loaded.layout, loaded.policy
  if layout.pose_columns is None or not policy.has_belief:
    raise ValueError("The policy has no belief: it needs pictures and the true pose in training.")
  scene = task.scene
  height = round(_SCALE * float(scene.extent[1][1] - scene.extent[0][1]))
  floor = floor_picture.draw(scene.free_space, scene.extent, height=height)
  timestep, agent = environment.reset(), Agent(policy, layout, seed=0, deterministic=True)
  goal = getattr(task, "goal", None)
  frames: list[np.ndarray] = []
  errors = agent.errors
  while not timestep.last() and len(errors) < max_steps:
    flat = layout.flatten(timestep.observation)
    action = agent.act(flat)
    truth = planar_pose(flat.privileged, layout.pose_columns)[:2]
    heat = belief_plot.draw(floor, *policy.belief(agent.embedding), truth=truth, target=goal)
    frames.append(_beside(flat.image, heat, f"step {len(errors) - 1}: {errors[-1]:.2f} m off"))
    timestep = environment.step(action)
  chosen = np.unique(np.linspace(0, len(frames) - 1, moments).round().astype(int))
  return [frames[i] for i in chosen], errors


def _beside(image: np.ndarray | None, heat: np.ndarray, text: str) -> np.ndarray:
  assert image is not None
  width = heat.shape[1]
  seen = cv2.resize(
    image, (width, round(width * image.shape[0] / image.shape[1])), interpolation=cv2.INTER_NEAREST
  )
  picture = np.concatenate([np.asarray(seen), heat])
  picture[:26] //= 3  # what is behind white letters may be bright
  cv2.putText(
    picture, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
  )
  return np.pad(picture, ((2, 2), (2, 2), (0, 0)), constant_values=255)


def montage(frames: list[np.ndarray]) -> np.ndarray:
  """Puts pictures of one size into rows."""
  frames = frames + [np.full_like(frames[0], 255)] * (-len(frames) % _COLUMNS)
  rows = [np.concatenate(frames[i : i + _COLUMNS], axis=1) for i in range(0, len(frames), _COLUMNS)]
  return np.concatenate(rows)


class Drawn(NamedTuple):
  """An episode's pictures and errors."""

  picture: np.ndarray  # uint8 [height, width, 3]
  errors: list[float]  # m between the belief's mean and the truth, of every step


def draw_episode(
  folder: Path, *, environment: str | None = None, seed: int, moments: int, max_steps: int
) -> Drawn:
  """Runs an episode with the policy's mean action and draws moments spread over it.

  Args:
    folder: Of an exported policy.
    environment: Name of another environment than the one that it was trained on.
    seed: Of the episode.
    moments: How many are drawn.
    max_steps: Longest episode [steps].

  Raises:
    ValueError: The folder holds no policy, or one without a belief; no moment, or no step.
  """
  if moments < 1 or max_steps < 1:
    raise ValueError(f"Found {moments} moments of {max_steps} steps, expected 1 or more of both.")
  loaded = load_policy(folder)
  made = make_environment(environment or loaded.environment, seed=seed, history=loaded.history)
  frames, errors = run_episode(loaded, made, moments=moments, max_steps=max_steps)
  return Drawn(montage(frames), errors)
