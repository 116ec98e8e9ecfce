"""The law from position error to duty of a servo that logs its duty, fitted by itself.

With the command u, the reading q and k the declared stiffness over the declared limit,

    duty(t) = clip(gain B(x(t); w) + integral I(t) + c, -saturation, saturation)
    x(t) = k (u(t / (1 + rate) - delay) - q(t + ahead)),  I = integral of x dt

where B takes a dead band w off, rate is of the readings' clock, and ahead is by how much a duty is
read later than a position, or the law's derivative over its gain: the readings do not tell these
apart. The readings feed the law, so that no motion is simulated: one regression for every delay,
rate and dead band of a grid. Deviations are of the blocks' scatter (Liang and Zeger 1986), or of
the logs' where that is more. Shapes: N samples of all logs, K columns.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.linalg import orth

from nerf2real.core import least_squares
from nerf2real.suite.effects import kind_of
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.model.servo.duty import duty_of
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_BANDS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Dead bands that are tried, in steps of the position's reading."""
_STEP, _COARSE, _NEAR = 0.001, 0.004, 0.016
"""s between delays that are tried, chosen: firmware and bus work in cycles of a millisecond; in a
first round, a quarter of a period at 60 Hz, faster than position errors change; and how far about
its best delay a second round goes, which a held command's plateau must not leave. Where a clock's
rate is sought, too, they are of the shifts at a log's middle and at its end."""
_FEWEST = 50  # samples of a line


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
  duties = _Duties(plant)
  if duties.kept.sum() < _FEWEST:
    return None
  delay, rate = duties.clock()
  band = duties.dead_band(delay, rate)
  law, left = duties.law(delay, rate, band)
  return (law, left) if law.interval[0] > 0.0 else None


class _Duties:
  """The duties of a joint's logs, and what laws leave of them.

  A line is of the columns [N, K]: what the declared law makes of a delay, a rate and a dead band,
  the speed, and a constant of every log.
  """

  def __init__(self, plant: JointPlant):
    logs = plant.logs
    self._plant = plant
    self._duty = np.concatenate([log.duty for log in logs])  # type: ignore[misc]
    self._top = float(np.abs(self._duty).max())
    free = np.abs(self._duty) < SETTINGS.saturated * self._top
    self.kept = free & np.concatenate([log.valid for log in logs])
    """Samples that a line is fitted to, bool [N]."""
    self._log_of = np.repeat(np.arange(len(logs)), [len(log.time) for log in logs])
    second = [np.floor(log.time / SETTINGS.block_s) + 1e6 * i for i, log in enumerate(logs)]
    self._block = np.concatenate(second)
    speed = np.concatenate([log.velocity for log in logs])
    self._beside = np.column_stack([speed, self._log_of[:, None] == np.arange(len(logs))])
    self._slope = abs(plant.declared[INDEX["position"]] / plant.declared[INDEX["highest"]])

  def clock(self) -> tuple[float, float]:
    """Returns the commands' delay [s] and the readings' clock's rate, zero where it is not worth
    its place."""
    basis = orth(self._beside[self.kept])

    def less_basis(values: Array) -> Array:
      return values[self.kept] - basis @ (basis.T @ values[self.kept])

    asked = less_basis(self._duty)

    def squares(delay: float, rate: float = 0.0) -> float:
      column = less_basis(_declared(self._plant, delay, rate))
      return float(asked @ asked - (column @ asked) ** 2 / max(float(column @ column), 1e-300))

    longest = max(float(log.time[-1] - log.time[0]) for log in self._plant.logs)
    delay = _best_delay(squares)
    late, drift = _best_clock(squares, longest)
    return (late, drift) if self._is_worth(squares(late, drift), squares(delay)) else (delay, 0.0)

  def dead_band(self, delay: float, rate: float) -> float:
    """Returns the dead band [rad] (m) of `_BANDS`, zero where it is not worth its place."""
    step = min(quantum(log.position) for log in self._plant.logs)

    def squares(band: float) -> float:
      columns = self._line(delay, rate, band)
      beta = np.linalg.lstsq(columns[self.kept], self._duty[self.kept], rcond=None)[0]
      return float(np.sum((self._duty - columns @ beta)[self.kept] ** 2))

    best, band = min((squares(steps * step), steps * step) for steps in _BANDS)
    return band if self._is_worth(best, squares(0.0)) else 0.0

  def law(self, delay: float, rate: float, band: float) -> tuple[ServoLaw, Array]:
    """Returns the law of a delay [s], a rate and a dead band, and what it leaves of the duty."""
    duty, kept, top = self._duty, self.kept, self._top
    columns = self._line(delay, rate, band)
    beta, spread = self._regressed(columns)
    total = self._integral(columns[:, 0])
    wound, wide = self._regressed(np.column_stack([total, columns]))
    gain_deviation, speed_deviation = np.maximum(spread[:2], self._between_logs(columns))
    made = np.clip(columns[:, :2] @ beta[:2], -top, top)
    left = duty - made
    is_clear = abs(wound[0]) > SETTINGS.worth * wide[0]
    rms = float(np.sqrt(np.mean(left[kept] ** 2)))
    law = ServoLaw(
      gain=float(beta[0]),
      gain_deviation=float(gain_deviation),
      delay=delay,
      ahead=float(-beta[1] / (beta[0] * self._slope)),
      ahead_deviation=float(abs(speed_deviation / (beta[0] * self._slope))),
      dead_band=band,
      integral=float(wound[0]),
      integral_deviation=float(wide[0]),
      wound=float(np.sqrt(np.mean((wound[0] * total) ** 2))) if is_clear else 0.0,
      saturation=top,
      left=rms,
      unexplained=rms / max(float(np.sqrt(np.mean(made[kept] ** 2))), 1e-12),
      rate=rate,
    )
    return law, left

  def _line(self, delay: float, rate: float, band: float) -> Array:
    declared = _declared(self._plant, delay, rate)
    return np.column_stack([_shrunk(declared, self._slope * band), self._beside])

  def _is_worth(self, squares: float, plain: float) -> bool:
    """Tells by the likelihoods' ratio whether lower squares are worth one value more."""
    blocks = len(np.unique(self._block[self.kept]))
    return (plain - squares) / squares * blocks > SETTINGS.worth**2

  def _regressed(self, columns: Array) -> tuple[Array, Array]:
    """Returns coefficients [K] of least squares and their deviations [K] by the blocks' scatter."""
    columns, duty = columns[self.kept], self._duty[self.kept]
    beta = np.linalg.pinv(columns.T @ columns) @ (columns.T @ duty)
    left = duty - columns @ beta
    spread = least_squares.block_covariance(columns.T, left, self._block[self.kept])
    return beta, least_squares.standard_deviations(spread)

  def _between_logs(self, columns: Array) -> Array:
    """Returns the deviations [2] of gain and speed by the scatter of the logs' own fits."""
    of_log = [self.kept & (self._log_of == i) for i in range(len(self._plant.logs))]
    apart = np.array(
      [
        np.linalg.lstsq(columns[m], self._duty[m], rcond=None)[0][:2]
        for m in of_log
        if m.sum() > _FEWEST
      ]
    )
    return apart.std(axis=0, ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else np.zeros(2)

  def _integral(self, x: Array) -> Array:
    """Returns the integral over time [s] of each log's samples [N]."""
    parts = [
      np.cumsum(x[self._log_of == i] * np.gradient(log.time))
      for i, log in enumerate(self._plant.logs)
    ]
    return np.concatenate(parts)


def _declared(plant: JointPlant, delay: float, rate: float) -> Array:
  """Returns the declared model's duty [N] without limits, at a command delay [s] and a clock's
  rate."""
  p = plant.declared.copy()
  p[INDEX["command_delay"]], p[INDEX["clock_rate"]] = delay, rate
  p[INDEX["lowest"]], p[INDEX["highest"]] = -np.inf, np.inf
  return np.concatenate([duty_of(plant, p, i) for i in range(len(plant.logs))])


def _shrunk(x: Array, band: float) -> Array:
  return np.sign(x) * np.maximum(np.abs(x) - band, 0.0)


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
