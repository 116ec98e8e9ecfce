"""Likelihood of one joint's logs by blocks of time, robust to what no hypothesis holds.

A block b of a channel (positions simulated from the commands alone; efforts given the measured
motion) has the mean squared residual m_b. Its variance is unknown, about s^2, worth as many
observations as the block has; with that integrated out

    log p_b = -n_b log(1 + m_b / s^2)

a multivariate t density. n_b counts independent samples: those of the block over the residual's
correlation time, readings that repeat the one before as one, as they round it once. s is what the
best hypothesis leaves in the median block, so that evidence counts in units of what remains. A
sample that is less sure than the others, as its stamp is off where a joint is fast, counts by the
share that the others' variance has in its own: all of one where what remains is far larger than
what stamps are off by. Shapes: N samples of all logs, B blocks, C channels, n values.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from nerf2real.sysid.fit.efforts import Duties, Torques, efforts_of
from nerf2real.sysid.fit.expectation import NOISE, Expectation
from nerf2real.sysid.fit.noise import correlation_time, once, timing
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.measured import block_starts, same_commands
from nerf2real.sysid.model.plant import Simulated
from nerf2real.sysid.model.servo.law import ServoLaw
from nerf2real.sysid.model.threads import at_once
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_NOTHING = np.zeros(0)
_RARE = 0.025  # share of recordings whose latency is later than what is allowed, as many earlier


class JointLikelihood:
  """The logs of one joint, cut into blocks; turns hypotheses into residuals and nats."""

  def __init__(self, plant: JointModel, *, settings: Settings = SETTINGS, follows: bool = False):
    """Cuts the logs into blocks and notes the readings' noise.

    Args:
      plant: the joint.
      settings: length of blocks, tolerances of efforts.
      follows: whether the simulated state is pulled to the readings, so that positions are those
        predicted from each reading on: a course with play does not repeat, as which way teeth
        bounce depends on microradians.
    """
    self.plant, self.settings, self.follows = plant, settings, follows
    self.position_noise, self.stamp_noise = timing(plant)
    logs = plant.logs
    self.effort = efforts_of(plant, settings)
    """The second channel, if there is one."""
    self.channels = ["course"]
    self.floor = np.array([self.position_noise])
    if self.effort is not None:
      self.channels.append("effort")
      self.floor = np.append(self.floor, self.effort.noise)
    self.mask = np.concatenate([log.valid for log in logs]).astype(float)
    self.speed = np.concatenate([log.velocity for log in logs])
    missed = np.concatenate([plant.reduction_error(i) for i in range(len(logs))])
    further = [(self.stamp_noise * self.speed) ** 2 + missed**2]
    if self.effort is not None:
      further.append((0.25 * self.effort.jumps()) ** 2)
    self._further = np.array(further)
    """Variance [C, N] of samples beside the noise that all have."""
    self._once = np.ones((len(self.channels), len(self.mask)))
    self._once[0] = np.concatenate([once(log.position) for log in logs])
    self.gain = self.mask * np.sqrt(self._shares(np.zeros(len(self.channels))))
    self._cut()
    self.expectation: Expectation | None = None
    self.scale = np.maximum(self.floor, 1e-12)
    self.observations = self.counts.copy()
    """Independent samples of blocks [C, B]."""
    self._known = self._measure(self.effort) if isinstance(self.effort, Duties) else None

  @property
  def law(self) -> ServoLaw | None:
    """The law of the joint's servo, where logs hold its duty."""
    return self.effort.law if isinstance(self.effort, Duties) else None

  def _shares(self, beyond: Array) -> Array:
    """Returns what part [C, N] the variance of the surest samples is of each one's, where mean
    squares `beyond` [C] remain besides the noise."""
    usual = (np.maximum(self.floor, 1e-12) ** 2 + beyond)[:, None]
    shares: Array = usual / (usual + self._further)
    return shares

  def _measure(self, duties: Duties) -> tuple[float, Array]:
    """Returns scale and independent samples [B] of what a servo's law leaves of the duty."""
    rows = np.zeros((2, self.size))
    rows[1] = duties.left_by_law * self.gain[1]
    scale, samples, times = self._scales(rows)
    return scale[1], samples[1] / times[1]

  def _scales(self, residuals: Array) -> tuple[Array, Array, Array]:
    """Returns scales [C], samples that count as sure [C, B] and correlation times [C, 1] of
    residuals [C, N]."""
    squares = self.squares(residuals)
    alike = residuals / np.sqrt(squares[:, self.block_of] + 1e-30)
    alike = (alike - alike.mean(axis=1, keepdims=True)) * np.sqrt(self._once)
    length = max(8, int(np.median(np.diff(self.starts)))) if len(self.starts) > 1 else self.size
    times = np.array([correlation_time(row, length) for row in alike])
    recordings = 1.0 if self.expectation is None else 1.0 + NOISE
    beyond = np.maximum(np.median(squares - recordings * self._noise, axis=1), 0.0)
    shares = np.add.reduceat(self.mask * self._once * self._shares(beyond), self.starts, axis=1)
    scale = np.sqrt(np.median(squares, axis=1) + self.floor**2)
    return scale, np.maximum(shares, 1.0), times[:, None]

  def _cut(self) -> None:
    starts, folds, offset = [], [], 0
    alone = len(self.plant.logs) == 1
    log_of, log_at = [], []
    for index, log in enumerate(self.plant.logs):
      first = block_starts(log.time, self.settings.block_s)
      starts.append(first + offset)
      half = np.arange(len(first)) // 2 % self.settings.folds
      folds.append(half if alone else np.full(len(first), index))
      log_of.append(np.full(len(first), index))
      log_at.append(np.full(len(log.time), index))
      offset += len(log.time)
    self.starts, self.fold = np.concatenate(starts), np.concatenate(folds)
    self.log_of, self.log_at = np.concatenate(log_of), np.concatenate(log_at)
    self.size = offset
    self.counts = np.maximum(np.add.reduceat(self.gain**2, self.starts, axis=1), 1.0)
    lengths = np.diff(np.append(self.starts, offset))
    self.block_of = np.repeat(np.arange(len(self.starts)), lengths)
    ends = np.append(self.starts, offset)[1:]
    self._parts: dict[int, list[slice]] = {int(fold): [] for fold in self.fold}
    for fold, start, end in zip(self.fold, self.starts, ends, strict=True):
      spans = self._parts[int(fold)]
      if spans and spans[-1].stop == start:
        start = spans.pop().start
      spans.append(slice(int(start), int(end)))

  @property
  def noise_squares(self) -> Array:
    """Mean squares of blocks [B] that the readings' noise leaves: with what the stamps of a joint
    that moves and its simulation among others are off by, so that such samples weigh less."""
    squares: Array = self._noise[0]
    return squares

  @property
  def _noise(self) -> Array:
    """The same of all channels [C, B]."""
    return self.floor[:, None] ** 2 * np.add.reduceat(self.mask, self.starts) / self.counts

  def parts_of(self, fold: int) -> list[slice]:
    """Returns where the samples of a fold are."""
    return self._parts.get(int(fold), [])

  def simulate(
    self, terms: Sequence[Term], xs: Array, logs: Sequence[int] | None = None
  ) -> list[list[tuple[Simulated, Simulated | None]]]:
    """Returns every log's open-loop run, and its run along the readings where torque is known."""
    chosen = list(range(len(self.plant.logs)) if logs is None else logs)
    along = self.effort is not None and self.effort.along and not self.follows
    ways = [self.follows] + [True] * along
    runs = []
    for x in np.atleast_2d(xs):
      c = compose(self.plant, terms, x)
      runs += [
        self.plant.prepared(c.p, c.loads, i, table=c.table, follow=way)
        for i in chosen
        for way in ways
      ]
    done = at_once(runs)
    pairs = [
      (done[k], done[k + len(ways) - 1] if along or self.follows else None)
      for k in range(0, len(done), len(ways))
    ]
    return [pairs[k : k + len(chosen)] for k in range(0, len(pairs), len(chosen))]

  def residuals(self, terms: Sequence[Term], xs: Array) -> Array:
    """Returns measured minus simulated [X, C, N]; masked samples are 0."""
    rows = []
    for outputs, x in zip(self.simulate(terms, xs), np.atleast_2d(xs), strict=True):
      course = [
        log.position - o.position for log, (o, _) in zip(self.plant.logs, outputs, strict=True)
      ]
      channels = [np.concatenate(course)]
      if self.effort is not None:
        p = compose(self.plant, terms, x).p
        channels.append(self.effort.left(p, self.gain[1], [along for _, along in outputs]))
      rows.append(channels)
    result = np.nan_to_num(np.array(rows), nan=1e3, posinf=1e3, neginf=-1e3)
    if self.expectation is not None:
      for row, x in zip(result, np.atleast_2d(xs), strict=True):
        row -= self.expectation.under(compose(self.plant, terms, x)[0])
        late, most = self._late(row[0]), self.expectation.apart
        row[0] -= np.clip(late - late.mean(), -most, most)[self.log_at] * self.speed
    return result * self.gain

  def courses(self, terms: Sequence[Term], x: Array) -> list[Array]:
    """Returns measured minus simulated position [N] of every log, rad (m); NaN where a reading
    repeats an earlier one."""
    (outputs,) = self.simulate(terms, x[None])
    return [
      np.where(log.valid, log.position - o.position, np.nan)
      for log, (o, _) in zip(self.plant.logs, outputs, strict=True)
    ]

  def _late(self, residual: Array) -> Array:
    """Returns the s by which each log [L] is earlier than simulated, by a residual course [N]."""
    weights = self.gain[0] ** 2 * self.speed
    moved, turned = (np.bincount(self.log_at, weights * row) for row in (residual, self.speed))
    return moved / np.maximum(turned, 1e-12)

  def expect(
    self,
    reference: "JointLikelihood",
    residuals: Array,
    terms: Sequence[Term] = (),
    x: Array = _NOTHING,
  ) -> bool:
    """Takes what a reference leaves for expected, where it was driven by the very same commands.

    By as much as its recordings are early or late among each other any other may be: cycles of a
    bus and of a loop begin anew with every recording. It is no more than what machines of one kind
    differ by.

    Args:
      reference: logs of the machine before.
      residuals: what its baseline leaves there [C, N], weighted as `residuals` gives it. Of a
        channel that only one side has, such as the duty of a servo that lost its law, nothing is
        expected.
      terms: of that baseline.
      x: their values [n].

    Returns:
      Whether every log has its like.
    """
    ends = np.cumsum([len(log.time) for log in reference.plant.logs])
    starts = np.append(0, ends[:-1])
    likes = []
    residuals = self._channels_of(reference, residuals / np.maximum(reference.gain, 1e-9))
    for log in self.plant.logs:
      like = next((i for i, r in enumerate(reference.plant.logs) if same_commands(log, r)), None)
      if like is None:
        return False
      other, keep = reference.plant.logs[like], reference.mask[starts[like] : ends[like]] > 0
      stamps = other.time[keep] + log.command_time[0] - other.command_time[0]
      likes.append((stamps, residuals[:, starts[like] : ends[like]][:, keep]))
    baseline = compose(reference.plant, terms, x)[0]
    late, apart = reference._late(residuals[0]), 0.0
    if len(late) > 1 and not self.follows:
      spread = float(np.sqrt(2.0) * late.std(ddof=1))  # of a difference of two recordings
      most = dict(self.settings.tolerances)["latency"]
      apart = min(spread * float(student.isf(_RARE, len(late) - 1)), most)
    self.expectation = Expectation(self.plant.logs, likes, baseline, apart=apart)
    return True

  def _channels_of(self, other: "JointLikelihood", rows: Array) -> Array:
    """Returns other logs' rows [C', N'] as these logs' channels [C, N'], 0 where one lacks it."""
    result = np.zeros((len(self.channels), rows.shape[1]))
    count = len(rows) if type(self.effort) is type(other.effort) else 1
    result[:count] = rows[:count]
    return result

  def effort_factor(self, terms: Sequence[Term], x: Array) -> float | None:
    """Returns measured effort over a hypothesis' torque; None where efforts are not compared with
    torques."""
    if not isinstance(self.effort, Torques) or self.follows:
      return None
    (outputs,) = self.simulate(terms, x[None])
    p = compose(self.plant, terms, x).p
    return self.effort.factor(p, self.gain[1], [along for _, along in outputs])

  def squares(self, residuals: Array) -> Array:
    """Returns mean squares of blocks [..., C, B]."""
    return np.add.reduceat(residuals**2, self.starts, axis=-1) / self.counts

  def alike(self, apart: Array) -> bool:
    """Tells whether courses that are so far apart [C, N] are the same but for a part of what
    remains."""
    mean = np.median(self.squares(apart), axis=1)
    return bool(np.all(mean < self.settings.alike**2 * self.scale**2))

  def loglik(self, squares: Array) -> Array:
    """Returns nats of blocks [..., B], channels added."""
    return -(self.observations * np.log1p(squares / self.scale[:, None] ** 2)).sum(axis=-2)

  def told_apart(self, apart: Array) -> Array:
    """Returns the nats of blocks [B] by which two predictions are told apart if one of them holds
    but for what remains.

    Args:
      apart: one less the other [C, N].
    """
    twice = 2.0 * self.scale[:, None] ** 2
    return (self.observations * np.log1p(self.squares(apart) / twice)).sum(axis=0)

  def weights(self, squares: Array) -> Array:
    """Returns the weight of every sample [C, N] in a step of least squares."""
    w = self.observations / (self.counts * (self.scale[:, None] ** 2 + squares))
    return w[:, self.block_of]

  def rescale(self, residuals: Array) -> None:
    """Sets the scale and the number of independent samples by the residuals [C, N] of a fit.

    Channels show one misfit: where courses go together for long, efforts count no more often. A
    duty is of the servo's law alone, which the readings feed: it counts by what that law leaves.
    """
    self.scale, samples, times = self._scales(residuals)
    self.observations = samples / np.maximum(times, times[0])
    if self._known is not None:
      self.scale[1], self.observations[1] = self._known


def rms_of(courses: Sequence[Array]) -> float:
  """Returns the RMS of residual courses [N], rad (m), over readings that are not NaN."""
  return float(np.sqrt(np.nanmean(np.square(np.concatenate(courses)))))
