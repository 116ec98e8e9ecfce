"""The law from position error to duty of a servo that logs its duty, fitted by itself.

With the command u, the reading q and k the declared stiffness over the declared limit,

    duty(t) = clip(gain B(x(t); w) + integral I(t) + c, -saturation, saturation)
    x(t) = k (u(t / (1 + rate) - delay) - q(t + ahead)),  I = integral of x dt

where B takes a dead band w off, rate is of the readings' clock, and ahead is by how much a duty is
read later than a position, or the law's derivative over its gain: the readings do not tell these
apart. The readings feed the law, so that no motion is simulated: one regression for every delay,
rate and dead band of a grid. Deviations
are of the blocks' scatter (Liang and Zeger 1986), or of the logs' where that is more. Shapes: N
samples of a log or of all, K columns, P kernel parameters (`kernel.NAMES`).
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.linalg import orth

from nerf2real.core import least_squares
from nerf2real.suite.effects import kind_of
from nerf2real.sysid.model.kernel import INDEX, NAMES
from nerf2real.sysid.model.measured import Measured, quantum
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_STEP, _COARSE, _NEAR = 0.001, 0.004, 0.016
"""s between delays that are tried, chosen: firmware and bus work in cycles of a millisecond; in a
first round, a quarter of a period at 60 Hz, faster than position errors change; and how far about
its best delay a second round goes, which a held command's plateau must not leave. Where a clock's
rate is sought, too, they are of the shifts at a log's middle and at its end."""
_BANDS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Dead bands that are tried, in steps of the position's reading."""
_FEWEST = 50  # samples of a line
_KEPT = 4  # torques: of a fit's place, of differences to it, further ahead

ASKED = [
  *(INDEX[name] for name in ("command_delay", "measurement_delay", "effort_delay", "clock_rate")),
  *(INDEX[name] for name in ("input", "constant", "position", "velocity")),
]
"""Kernel parameters by which the torque is that a law asks for."""


@dataclasses.dataclass(frozen=True)
class ServoLaw:
  """The law of a joint's servo, with standard deviations."""

  gain: float
  """Over the declared one."""
  gain_deviation: float
  delay: float
  """s between a command and the duty."""
  ahead: float
  """s by which the positions that the duty is of are later than those that are logged with it."""
  ahead_deviation: float
  """Of that."""
  dead_band: float
  """rad (m) of position error."""
  integral: float
  """1/s, of the declared proportional part."""
  integral_deviation: float
  wound: float
  """rms of what the integral makes of the duty, zero where it is not clear of none."""
  saturation: float
  """Largest duty."""
  left: float
  """rms of what gain, delay and ahead leave, of full duty."""
  unexplained: float
  """The same over the rms of what they make."""
  rate: float = 0.0
  """s gained per second by the readings' clock, zero where that is not clear of none."""

  @property
  def interval(self) -> tuple[float, float]:
    """95 % interval of the gain."""
    reach = SETTINGS.sigmas * self.gain_deviation
    return self.gain - reach, self.gain + reach

  def is_off(self, tolerance: float) -> bool:
    """Tells whether the gain is off the declared one by more than a share, all of its interval.

    What the law leaves of the duty may hide as much of the gain: no deviation by scatter shows it.
    More where it leaves more than it makes: what is wrong with the position errors lowers the gain
    by as much as the regression of these on the duty raises it (Frisch 1934).
    """
    reach = tolerance + self.gain * max(self.unexplained, self.unexplained**2)
    low, high = self.interval
    return low > 1.0 + reach or high < 1.0 - reach


def servo_law(plant: JointPlant) -> tuple[ServoLaw, Array] | None:
  """Returns the law, and what gain, delay and ahead leave of the duty [N]; None where the logs hold
  too little of it, or a duty that does not clearly push towards the command.

  Args:
    plant: a joint whose logs all hold the duty, or not.
  """
  if not plant.logs_duty:
    return None
  logs = plant.logs
  duty = np.concatenate([log.duty for log in logs])  # type: ignore[misc]
  speed = np.concatenate([log.velocity for log in logs])
  top = float(np.abs(duty).max())
  kept = (np.abs(duty) < SETTINGS.saturated * top) & np.concatenate([log.valid for log in logs])
  if kept.sum() < _FEWEST:
    return None
  log_of = np.repeat(np.arange(len(logs)), [len(log.time) for log in logs])
  beside = np.column_stack([speed, log_of[:, None] == np.arange(len(logs))])
  step = min(quantum(log.position) for log in logs)
  slope = abs(plant.declared[INDEX["position"]] / plant.declared[INDEX["highest"]])

  second = [np.floor(log.time / SETTINGS.block_s) + 1e6 * i for i, log in enumerate(logs)]
  block = np.concatenate(second)

  basis = orth(beside[kept])

  def less_basis(values: Array) -> Array:
    return values[kept] - basis @ (basis.T @ values[kept])

  asked = less_basis(duty)

  def squares(delay: float, rate: float = 0.0) -> float:
    column = less_basis(_declared(plant, delay, rate))
    return float(asked @ asked - (column @ asked) ** 2 / max(float(column @ column), 1e-300))

  def line(delay: float, rate: float, band: float) -> tuple[float, Array]:
    columns = np.column_stack([_shrunk(_declared(plant, delay, rate), slope * band), beside])
    beta = np.linalg.lstsq(columns[kept], duty[kept], rcond=None)[0]
    return float(np.sum((duty - columns @ beta)[kept] ** 2)), columns

  def is_worth(squares: float, plain: float) -> bool:  # by the likelihoods' ratio
    return (plain - squares) / squares * len(np.unique(block[kept])) > SETTINGS.worth**2

  delay, rate = _best_delay(squares), 0.0
  longest = max(float(log.time[-1] - log.time[0]) for log in logs)
  late, drift = _best_clock(squares, longest)
  if is_worth(squares(late, drift), squares(delay)):
    delay, rate = late, drift
  best, band = min((line(delay, rate, steps * step)[0], steps * step) for steps in _BANDS)
  if not is_worth(best, squares(delay, rate)):
    band = 0.0
  columns = line(delay, rate, band)[1]
  beta, spread = _regressed(columns[kept], duty[kept], block[kept])
  total = np.concatenate(
    [_integral(columns[log_of == i, 0], log.time) for i, log in enumerate(logs)]
  )
  wound, wide = _regressed(np.column_stack([total, columns])[kept], duty[kept], block[kept])
  apart = np.array(
    [
      np.linalg.lstsq(columns[m], duty[m], rcond=None)[0][:2]
      for m in (kept & (log_of == i) for i in range(len(logs)))
      if m.sum() > _FEWEST
    ]
  )
  between = apart.std(axis=0, ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else np.zeros(2)
  gain_deviation, speed_deviation = np.maximum(spread[:2], between)
  left = duty - np.clip(columns[:, :2] @ beta[:2], -top, top)
  is_clear = abs(wound[0]) > SETTINGS.worth * wide[0]
  law = ServoLaw(
    gain=float(beta[0]),
    gain_deviation=float(gain_deviation),
    delay=delay,
    ahead=float(-beta[1] / (beta[0] * slope)),
    ahead_deviation=float(abs(speed_deviation / (beta[0] * slope))),
    dead_band=band,
    integral=float(wound[0]),
    integral_deviation=float(wide[0]),
    wound=float(np.sqrt(np.mean((wound[0] * total) ** 2))) if is_clear else 0.0,
    saturation=top,
    left=(rms := float(np.sqrt(np.mean(left[kept] ** 2)))),
    unexplained=rms / max(float(np.sqrt(np.mean((duty - left)[kept] ** 2))), 1e-12),
    rate=rate,
  )
  return (law, left) if law.interval[0] > 0.0 else None


def _best_delay(squares: Callable[[float], float]) -> float:
  """Returns the delay [s] of least squares, within what is plausible of late commands.

  Held commands give plateaus of equal squares: the middle of the best.
  """
  most = kind_of("command_delay").parameter("delay").high
  coarse = np.arange(0.0, most + _COARSE / 2, _COARSE)
  near = coarse[np.argmin([squares(delay) for delay in coarse])]
  fine = np.arange(max(near - _NEAR, 0.0), near + _NEAR + _STEP / 2, _STEP)
  found = np.array([squares(delay) for delay in fine])
  return float(np.median(fine[found <= found.min() * (1.0 + 1e-6)]))


def _best_clock(squares: Callable[[float, float], float], longest: float) -> tuple[float, float]:
  """Returns the delay [s] at the beginning of logs and the clock's rate of least squares, within
  what is plausible of both.

  Rates are sought by the shifts that they make at the end of the longest log [s], and delays by
  those at its middle: nearly independent of each other.
  """
  most, fastest = (
    kind_of(kind).parameter(name).high
    for kind, name in (("command_delay", "delay"), ("clock_drift", "rate"))
  )
  ends = np.arange(-fastest * longest, fastest * longest + _NEAR, 2.0 * _NEAR)
  middles = np.arange(ends[0] / 2.0, most + ends[-1] / 2.0, _NEAR)
  step = 2.0 * _NEAR
  while True:
    found = {}
    for end in ends:
      rate = min(max(end / longest, -fastest), fastest)
      for middle in middles:
        delay = middle - 0.5 * rate * longest
        if 0.0 <= delay <= most:
          found[squares(delay, rate), middle, end] = delay, rate
    least = min(found)
    if step <= 2.0 * _STEP:
      return found[least]
    step /= 4.0
    ends = least[2] + step * np.arange(-4, 5)
    middles = least[1] + step / 2.0 * np.arange(-4, 5)


def duty_of(plant: JointPlant, p: Array, index: int, *, ahead: float = 0.0) -> Array:
  """Returns the duty [N] that a servo's law makes of a log's commands and readings.

  Supply and heat change the torque at a duty, not the duty.

  Args:
    plant: the joint.
    p: kernel parameters [P].
    index: of the log.
    ahead: s by which the positions that the duty is of are later than those read with it.
  """
  return duty_for(plant, p, asked_torque(plant, p, index, ahead=ahead))


def asked_torque(plant: JointPlant, p: Array, index: int, *, ahead: float = 0.0) -> Array:
  """Returns the torque [N] that a law of gain 1 asks for, without limits: `duty_of`'s arguments. Of
  the parameters `ASKED` alone matter."""
  value = dict(zip(NAMES, p, strict=True))
  log, rate = plant.logs[index], 1.0 + value["clock_rate"]
  true = log.time / rate - value["effort_delay"]
  command = _held(log, true - value["command_delay"])
  stamp = (true + value["measurement_delay"] + ahead) * rate
  read, speed = (np.interp(stamp, log.time, row) for row in (log.position, log.velocity))
  torque = value["input"] * command + value["constant"]
  return torque + value["position"] * read + value["velocity"] * speed


class Asked:
  """What `asked_torque` returns for all logs of a joint; the last few are kept: of the differences
  that a fit takes most leave it as it is."""

  def __init__(self, plant: JointPlant):
    self._plant = plant
    self._kept: dict[tuple[bytes, float], Array] = {}

  def torque(self, p: Array, ahead: float) -> Array:
    """Returns the torque [N] of kernel parameters [P]; `ahead` as of `duty_of`."""
    key, logs = (p[ASKED].tobytes(), ahead), range(len(self._plant.logs))
    torque = self._kept.pop(key, None)
    if torque is None:
      torque = np.concatenate([asked_torque(self._plant, p, i, ahead=ahead) for i in logs])
    self._kept[key] = torque
    if len(self._kept) > _KEPT:
      self._kept.pop(next(iter(self._kept)))
    return torque


def duty_for(plant: JointPlant, p: Array, torque: Array) -> Array:
  """Returns the duty [N] of kernel parameters [P] for a torque [N] asked for by `asked_torque`."""
  value = dict(zip(NAMES, p, strict=True))
  limited = np.clip(value["gain"] * torque, value["lowest"], value["highest"])
  return limited / (value["strength"] * plant.declared[INDEX["highest"]])


def command_jump(plant: JointPlant, index: int, within: float, *, delay: float = 0.0) -> Array:
  """Returns by how much of full duty [N] commands jump within so many seconds of a sample, heard
  after a delay."""
  log = plant.logs[index]
  heard = log.time - delay
  slope = plant.declared[INDEX["input"]] / plant.declared[INDEX["highest"]]
  return np.abs(slope * (_held(log, heard + within) - _held(log, heard - within)))


def _held(log: Measured, time: Array) -> Array:
  """Returns the last command [N] at each time [N]."""
  at = np.searchsorted(log.command_time, time, side="right") - 1
  return log.command[np.clip(at, 0, None)]


def _declared(plant: JointPlant, delay: float, rate: float) -> Array:
  """Returns the declared model's duty [N] without limits, at a command delay [s] and a clock's
  rate."""
  p = plant.declared.copy()
  p[INDEX["command_delay"]], p[INDEX["clock_rate"]] = delay, rate
  p[INDEX["lowest"]], p[INDEX["highest"]] = -np.inf, np.inf
  return np.concatenate([duty_of(plant, p, i) for i in range(len(plant.logs))])


def _shrunk(x: Array, band: float) -> Array:
  return np.sign(x) * np.maximum(np.abs(x) - band, 0.0)


def _integral(x: Array, time: Array) -> Array:
  return np.cumsum(x * np.gradient(time))


def _regressed(columns: Array, values: Array, block: Array) -> tuple[Array, Array]:
  """Returns coefficients [K] of least squares and their deviations [K] by the blocks' scatter."""
  beta = np.linalg.pinv(columns.T @ columns) @ (columns.T @ values)
  spread = least_squares.block_covariance(columns.T, values - columns @ beta, block)
  return beta, least_squares.standard_deviations(spread)
