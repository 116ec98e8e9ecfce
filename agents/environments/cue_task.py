"""A small visual memory task: a cue is seen at the start, and must be acted upon when it is gone.

For the first steps a coloured patch stands left or right in a 30x40 picture; then only the same
noisy grey is seen. From then on each step is rewarded with side * clip(action): a policy without
memory cannot infer the side, so that its best expected return is 0; one that remembers gets
`REWARDED_STEPS`. It shows that pictures, the LSTM's state, stored initial states and trajectories
work together.
"""

from typing import Any

import dm_env
import numpy as np
from dm_env import specs

IMAGE_SHAPE = (30, 40, 3)
CUE_STEPS = 2  # observations that show the cue
EPISODE_STEPS = 24  # actions; longer than a trajectory of the preset, so that states must be stored
REWARDED_STEPS = EPISODE_STEPS - CUE_STEPS  # return of the best policy with memory
_GREY, _NOISE = 110, 12  # 8-bit levels
_PATCH_ROWS, _PATCH_LEFT, _PATCH_RIGHT = slice(8, 22), slice(4, 16), slice(24, 36)
_PATCH_COLOUR = (220, 60, 40)


class CueTask(dm_env.Environment):
  """A task of stepping to the side on which a patch was shown."""

  def __init__(self, *, seed: int):
    self._random = np.random.default_rng(seed)
    self._side = 1
    self._steps = 0
    self._over = True

  def reset(self) -> dm_env.TimeStep:
    self._side = int(self._random.choice([-1, 1]))
    self._steps = 0
    self._over = False
    return dm_env.restart(self._observe())

  def step(self, action: Any) -> dm_env.TimeStep:
    if self._over:
      return self.reset()
    seen = self._steps < CUE_STEPS
    reward = 0.0 if seen else self._side * float(np.clip(np.ravel(action)[0], -1, 1))
    self._steps += 1
    if self._steps >= EPISODE_STEPS:
      self._over = True
      return dm_env.termination(reward, self._observe())
    return dm_env.transition(reward, self._observe())

  def _observe(self) -> dict[str, np.ndarray]:
    image = self._random.normal(_GREY, _NOISE, IMAGE_SHAPE)
    if self._steps < CUE_STEPS:
      columns = _PATCH_LEFT if self._side < 0 else _PATCH_RIGHT
      image[_PATCH_ROWS, columns] = _PATCH_COLOUR
    return {
      "camera": np.clip(image, 0, 255).astype(np.uint8),
      "clock": np.array([self._steps / EPISODE_STEPS], np.float32),
      "privileged/side": np.array([self._side], np.float32),
    }

  def observation_spec(self) -> dict[str, specs.Array]:
    return {
      "camera": specs.BoundedArray(IMAGE_SHAPE, np.uint8, 0, 255, "camera"),
      "clock": specs.BoundedArray((1,), np.float32, 0, 1, "clock"),
      "privileged/side": specs.BoundedArray((1,), np.float32, -1, 1, "privileged/side"),
    }

  def action_spec(self) -> specs.BoundedArray:
    return specs.BoundedArray((1,), np.float32, -1.0, 1.0, "action")
