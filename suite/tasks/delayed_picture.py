"""The robot's picture, late: it shows the state that the world was in a little earlier.

A camera slower than the control rate gives a picture at its own rate, at a phase drawn for each
episode; the last one stays between two.
"""

import time

import mujoco
import numpy as np

from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import RobotCamera
from nerf2real.suite.sensors.delays import StepRing

_ROUNDING = 1e-9  # of a frame


class DelayedPicture:
  """Keeps the last states and renders the one that the newest picture to arrive shows."""

  def __init__(
    self,
    model: mujoco.MjModel,
    camera: RobotCamera,
    *,
    randomisation: RandomisationSettings,
    timestep: float,
    substeps: int,
  ):
    """Allocates the memory.

    Args:
      model: The compiled model.
      camera: The camera, bound to it.
      randomisation: Ranges of delay and jitter.
      timestep: Physics step [s].
      substeps: Physics steps in a control step.
    """
    self._model, self._camera = model, camera
    self._timestep = timestep
    oldest = (
      camera.settings.latency + randomisation.delay_range[1] + randomisation.jitter_half_width
    )
    self._trace = StepRing(int(np.ceil(oldest / timestep)) + substeps + 1, model.nq)
    self._past = mujoco.MjData(model)  # the state that is shown
    self._frames_per_step = camera.settings.rate * constants.CONTROL_TIMESTEP
    self._phase = 0.0  # of a frame, since the last one
    self._picture: np.ndarray | None = None  # the last one
    self.render_time = 0.0  # s spent on pictures so far

  def reset(self, qpos: np.ndarray, random_state: np.random.RandomState) -> None:
    """Starts an episode in which the world has been as it is now for a long time."""
    self._trace.fill(qpos)
    self._picture = None
    # No number is taken where none is needed: the other draws of a seed stay as they are.
    self._phase = random_state.uniform() if self._frames_per_step < 1 else 0.0

  def record(self, qpos: np.ndarray) -> None:
    """Notes the state at the end of a physics step."""
    self._trace.push(qpos)

  def take(self, delay: float, *, jitter: float, random_state: np.random.RandomState) -> np.ndarray:
    """Returns the picture that has arrived by now, uint8 [H, W, 3].

    Args:
      delay: The episode's delay [s]; the camera's own latency is added.
      jitter: Half width of the uniform jitter [s].
      random_state: Source of the jitter and of the sensor's noise.
    """
    self._phase += self._frames_per_step
    if self._picture is not None and self._phase < 1 - _ROUNDING:
      return self._picture
    if self._phase >= 1 - _ROUNDING:
      self._phase -= 1
    begin = time.perf_counter()
    self._picture = self._render(delay, jitter, random_state)
    self.render_time += time.perf_counter() - begin
    return self._picture

  def _render(self, delay: float, jitter: float, random_state: np.random.RandomState) -> np.ndarray:
    delay += self._camera.settings.latency
    if jitter:
      delay = max(0.0, delay + random_state.uniform(-1, 1) * jitter)
    age = min(round(delay / self._timestep), len(self._trace) - 1)
    return self.of(self._trace.back(age), random_state)

  def of(self, qpos: np.ndarray, random_state: np.random.RandomState | None = None) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of a state.

    Args:
      qpos: The state.
      random_state: Source of the sensor's noise; without one there is none.
    """
    self._past.qpos[:] = qpos
    mujoco.mj_kinematics(self._model, self._past)
    mujoco.mj_camlight(self._model, self._past)
    return self._camera.render(self._past, random_state)
