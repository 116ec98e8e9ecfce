"""The motors of the virtual servos: position error to duty, duty to current, current to torque.

XM430-W350 in P-only position mode is a voltage law (e-Manual, "Position PID gain", and the data
sheet): duty = P / 128 * (goal - present) / 885, clipped to the PWM limit; voltage = duty * supply.
Then a DC motor behind a gear, in quantities of the output shaft:

  current = (voltage - k * speed) / R          k = 12 V / 46 rpm, R = 12 V / 2.3 A
  torque  = k * current
  friction = dry + share * |torque| + rest     opposes motion; the solver of MuJoCo applies it

The last term, none in a usual servo, grows while the joint rests and is gone when it moves.

The constants of speed (no load) and of torque (stall) in the data sheet differ by 28 %: that is the
`share` of the torque which the gear takes away. N servos.
"""

import dataclasses

import numpy as np

COUNTS = 4096  # of one turn (12-bit encoder on the output)
CENTER = 2048  # counts at joint angle 0
FULL_PWM = 885  # register value of the whole supply voltage
CURRENT_UNIT = 0.00269  # A
SPEED_UNIT = 0.229 * 2 * np.pi / 60  # rad/s
SPEED_CONSTANT = 12.0 / (46 * 2 * np.pi / 60)  # V s/rad at the output: no load, data sheet
RESISTANCE = 12.0 / 2.3  # Ohm: stall current at 12 V, data sheet
STALL_TORQUE = 4.1  # N m at 12 V, data sheet
GEAR_SHARE = 1 - STALL_TORQUE / (SPEED_CONSTANT * 12.0 / RESISTANCE)  # 0.28
_P_DIVISOR = 128.0
# Chosen: a small metal gear motor warms by 8 K for each watt, with a time constant of ten minutes.
_HEATING, _WARMING_TIME, _AMBIENT = 8.0, 600.0, 25.0  # K/W, s, degrees C
_COMPUTER_CURRENT = 1.5  # A that everything but the servos draws: chosen
_DIP_TIME = 0.1  # s, time constant of the servos' supply voltage: chosen
_BROWN_OUT = 6.0  # V below which a servo's controller resets: chosen
_REST_SPEED = 0.05  # rad/s below which a joint rests; chosen: above the creep of soft friction


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotorParameters:
  """What differs from servo to servo and from battery to battery."""

  strength: np.ndarray
  """[N] factor on the torque."""
  gear_share: np.ndarray
  """[N] friction as a share of the torque."""
  dry_friction: np.ndarray
  """[N] N m."""
  encoder_offset: np.ndarray
  """[N] counts that the encoder reads too much."""
  goal_delay: float = 0.0
  """s from the arrival of a goal to its effect."""
  battery_voltage: float = 12.0
  """V without load."""
  battery_resistance: float = 0.08
  """Ohm."""
  battery_course: tuple[tuple[float, float], ...] = ()
  """(s in use, V without load), straight lines between; constant `battery_voltage` if empty."""
  battery_age: float = 0.0
  """s that the battery was in use when the robot was switched on."""
  rest_friction: float = 0.0
  """N m by which dry friction grows while a joint rests."""
  rest_time: float = 0.5
  """s, time constant of that growth."""

  @classmethod
  def nominal(cls, count: int) -> "MotorParameters":
    """Returns servos as the data sheet has them."""
    return cls(
      strength=np.ones(count),
      gear_share=np.full(count, GEAR_SHARE),
      dry_friction=np.full(count, 0.03),
      encoder_offset=np.zeros(count),
    )


class Motors:
  """The state of N servos' motors and of the battery."""

  def __init__(self, parameters: MotorParameters):
    """Starts with torque off, at ambient temperature."""
    count = len(parameters.strength)
    self.parameters = parameters
    # Contents of the registers.
    self.goal = np.full(count, CENTER, np.float64)  # counts
    self.enabled = np.zeros(count, bool)
    self.p_gain = np.full(count, 800.0)
    self.pwm_limit = np.full(count, 885.0)
    # What is measured.
    self.counts = np.full(count, float(CENTER))
    self.speed = np.zeros(count)  # rad/s
    self.duty = np.zeros(count)
    self.current = np.zeros(count)  # A
    self.temperature = np.full(count, _AMBIENT)
    self._rested = np.zeros(count)  # s
    self._begun: float | None = None  # s, of the first step
    self._course = np.array(parameters.battery_course, np.float64).reshape(-1, 2).T
    self.supply = self._battery(0.0)  # V
    self.slow_supply = self.supply  # V, as the servos measure it: without short dips
    self.stuck, self.is_stuck = np.zeros(count, bool), False
    self.forced_voltage: float | None = None
    self._late_goals: list[tuple[float, np.ndarray]] = []
    self._effective_goal = self.goal.copy()
    self._offset = CENTER + parameters.encoder_offset
    self._torque_constant = SPEED_CONSTANT * parameters.strength

  @property
  def browned_out(self) -> bool:
    """Whether the supply is too low for the servos' controllers."""
    return self.supply < _BROWN_OUT

  def _battery(self, time: float) -> float:
    """Returns the battery's voltage without load [V] after a time in which torque was computed."""
    if not self._course.size:
      return self.parameters.battery_voltage
    return float(np.interp(time + self.parameters.battery_age, *self._course))

  def measure(self, angle: np.ndarray, speed: np.ndarray) -> None:
    """Reads the encoders: joint angles [N] [rad] and speeds [N] [rad/s]."""
    counts = np.rint(angle * (COUNTS / (2 * np.pi)) + self._offset)
    self.counts = np.where(self.stuck, self.counts, counts) if self.is_stuck else counts
    self.speed = speed

  def set_goal(self, index: int, counts: int, time: float) -> None:
    """Takes a goal that arrived at a time [s]."""
    self.goal[index] = counts
    if self.parameters.goal_delay > 0:
      self._late_goals.append((time + self.parameters.goal_delay, self.goal.copy()))
    else:
      self._effective_goal[index] = counts

  def torque(self, time: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns torque [N] and largest dry friction [N] [N m] for the next period [s]."""
    while self._late_goals and self._late_goals[0][0] <= time:
      self._effective_goal = self._late_goals.pop(0)[1]
    values = self.parameters
    duty = (self.p_gain / _P_DIVISOR) * (self._effective_goal - self.counts)
    np.minimum(duty, self.pwm_limit, out=duty)
    np.maximum(duty, -self.pwm_limit, out=duty)
    duty *= self.enabled / FULL_PWM
    current = duty * (self.supply / RESISTANCE)
    current -= self.speed * (self.enabled * (SPEED_CONSTANT / RESISTANCE))
    torque = self._torque_constant * current
    self.duty, self.current = duty, current
    drawn = _COMPUTER_CURRENT + max(0.0, float(duty @ current))
    if self.forced_voltage is not None:
      self.supply = self.forced_voltage
    else:
      self._begun = time if self._begun is None else self._begun
      self.supply = self._battery(time - self._begun) - values.battery_resistance * drawn
    self.slow_supply += (self.supply - self.slow_supply) * (period / _DIP_TIME)
    share = period / _WARMING_TIME
    self.temperature *= 1 - share
    self.temperature += (_HEATING * RESISTANCE * share) * current * current + _AMBIENT * share
    friction = values.dry_friction + values.gear_share * np.abs(torque)
    if values.rest_friction > 0:
      self._rested = np.where(np.abs(self.speed) < _REST_SPEED, self._rested + period, 0.0)
      friction += values.rest_friction * (1 - np.exp(-self._rested / values.rest_time))
    return torque, friction
