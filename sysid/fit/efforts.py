"""What an actuator was seen to do, less what a hypothesis makes of it: a joint's second channel.

A duty is of the servo's law alone, which the readings feed. An effort is the torque of the joint
along the measured motion, in a unit that is a printed constant. Shapes: N samples of all logs, P
kernel parameters.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.noise import effort_noise
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import Simulated
from nerf2real.sysid.model.servo.duty import Asked, command_jump, duty_for
from nerf2real.sysid.model.servo.law import ServoLaw
from nerf2real.sysid.settings import Settings

Array = np.ndarray

Runs = Sequence[Simulated | None]
"""A run along the readings of every log; None where no torque is compared."""


class Duties:
  """Duties of a servo whose law the logs show."""

  along = False
  """Whether what is expected needs runs along the readings."""

  def __init__(self, plant: JointModel, law: ServoLaw, left: Array, settings: Settings):
    """Takes the law.

    Args:
      plant: the joint; all its logs hold duties.
      law: of its servo.
      left: what that leaves of the duty [N].
      settings: tolerances of the law's gain.
    """
    self.law, self.left_by_law = law, left
    self.ahead: tuple[float, float] | None = None
    """Interval of the s that positions were ahead of duties in a reference: what is more now is a
    late reading. Without one the law's own holds both."""
    readings: list[Array] = [log.duty for log in plant.logs]  # type: ignore[misc]
    self.noise = effort_noise(readings)
    self._measured = np.concatenate(readings)
    self._plant, self._settings, self._asked = plant, settings, Asked(plant)

  def jumps(self) -> Array:
    """Returns by how much duties [N] jump near a sample, where commands do that the law hears."""
    plant, law = self._plant, self.law
    logs = range(len(plant.logs))
    near = [command_jump(plant, i, 2.0 * plant.step, delay=law.delay) for i in logs]
    return law.gain * np.concatenate(near)

  def left(self, p: Array, gain: Array, _: Runs) -> Array:
    """Returns measured duty minus that of the law of kernel parameters [P].

    A gain of the law within what a data sheet leaves open is taken for the declared one: of its
    interval, as other latencies show other gains, the one that fits best. So it is with what
    positions were ahead of duties in a reference.

    Args:
      p: the parameters.
      gain: of samples [N], whose squares weigh them.
    """
    late, measured = _late(p), self._measured
    ahead = self.law.ahead - late if self.ahead is None else float(np.mean(self.ahead))
    duties = self._duties(p, ahead)
    free = gain**2 * (np.abs(duties) < self._settings.saturated * np.abs(duties).max())
    factor = float(free * duties @ measured) / max(float(free * duties @ duties), 1e-12)
    known = self.law.gain if self.law.is_off(self._settings.duty_scale) else 1.0
    p = p.copy()
    p[INDEX["gain"]] *= np.clip(factor, *(np.array(self.law.interval) / known))
    duties = self._duties(p, ahead)
    if self.ahead is not None and self.ahead[1] > self.ahead[0]:
      reach = 0.5 * (self.ahead[1] - self.ahead[0])
      further = (self._duties(p, ahead + reach) - duties) / reach
      by = float(free * further @ (measured - duties)) / max(float(free * further @ further), 1e-12)
      duties = self._duties(p, ahead + float(np.clip(by, -reach, reach)))
    return measured - duties

  def _duties(self, p: Array, ahead: float) -> Array:
    return duty_for(self._plant, p, self._asked.torque(p, ahead))


class Torques:
  """Efforts as a current or a sensor of torque gives them."""

  along = True

  def __init__(self, plant: JointModel, settings: Settings):
    """Takes the readings.

    Args:
      plant: the joint; all its logs hold efforts.
      settings: tolerances of their unit.
    """
    self._readings: list[Array] = [log.effort for log in plant.logs]  # type: ignore[misc]
    self.noise = effort_noise(self._readings)
    self.unit: float | None = None
    """Effort over torque in a reference: a sensor's unit stays. None where none shows it."""
    self._measured = np.concatenate(self._readings)
    self._plant, self._settings = plant, settings

  def jumps(self) -> Array:
    """Returns by how much efforts [N] jump from a sample to a neighbour."""
    steps = [np.pad(np.abs(np.diff(effort)), 1) for effort in self._readings]
    return np.concatenate([np.maximum(step[1:], step[:-1]) for step in steps])

  def left(self, p: Array, gain: Array, runs: Runs) -> Array:
    """Returns measured effort minus simulated torque [N], in the readings' unit: without a
    reference all torques larger by one factor leave the same.

    Args:
      p: kernel parameters [P], with the motor's gain, which a current may tell (a worn brush) or
        not (a weak magnet).
      gain: of samples [N], whose squares weigh them.
      runs: along the readings.
    """
    torque, speed, factor = self._compared(p, gain, runs, float(p[INDEX["gain"]]))
    left = self._measured - factor * torque
    # A current's torque lacks what the back-EMF takes.
    seen = gain**2 * speed
    return left - float(left @ seen) / (float(seen @ speed) + 1e-12) * speed

  def factor(self, p: Array, gain: Array, runs: Runs) -> float:
    """Returns measured effort over the torque of kernel parameters: `left`'s arguments."""
    return self._compared(p, gain, runs)[2]

  def _compared(
    self, p: Array, gain: Array, runs: Runs, motor: float = 1.0
  ) -> tuple[Array, Array, float]:
    """Returns simulated torque [N], speed [N] and measured effort over that torque: within what
    torque constants leave open, or what it was in a reference, with a motor's gain or without."""
    torque = np.concatenate([run.torque for run in runs])  # type: ignore[union-attr]
    speed = self._speed(p)
    measured, both = gain * self._measured, gain * np.array([torque, speed])
    scale = float(np.linalg.lstsq(both @ both.T, both @ measured, rcond=None)[0][0])
    units: tuple[float, ...] = (1.0,)
    spread = self._settings.effort_scale
    if self.unit is not None:
      units = (self.unit, self.unit / motor)
      spread = self._settings.effort_repeats
    near = [float(np.clip(scale, u / (1.0 + spread), u * (1.0 + spread))) for u in units]
    return torque, speed, min(near, key=lambda factor: abs(factor - scale))

  def _speed(self, p: Array) -> Array:
    """Returns the speed [N] at the time that efforts show: what positions show that are as much
    later as they are read later, under kernel parameters [P]."""
    late, logs = _late(p), self._plant.logs
    if late == 0.0:
      return np.concatenate([log.velocity for log in logs])
    return np.concatenate([np.interp(log.time + late, log.time, log.velocity) for log in logs])


def _late(p: Array) -> float:
  """Returns the s by which positions are read later than efforts."""
  return float(p[INDEX["measurement_delay"]] - p[INDEX["effort_delay"]])


def efforts_of(plant: JointModel, settings: Settings) -> Duties | Torques | None:
  """Returns the second channel of a joint's logs, None where they hold none that can be compared:
  efforts of a joint whose actuator holds no position are no more than its commands."""
  if plant.law is not None:
    return Duties(plant, *plant.law, settings)
  if plant.holds and all(log.effort is not None for log in plant.logs):
    return Torques(plant, settings)
  return None
