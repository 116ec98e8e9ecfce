"""The camera: how late its pictures are and how long its lens is, against the measured motion.

The joints are moved as they were measured; the model says where its camera then looks. A feature
that a picture stamped t1 shows at p1 is expected in the one of t2 at

    project(M' R2' R1 M ray(p1) + rho M' R2' (c1 - c2)),  R, c: the camera's pose at t - delay,

through the lens on `/camera/camera_info` with its focal length times `scale`. What no effect is
made of is fitted beside them: M, a small rotation of the mount (no camera sits where it was drawn),
and rho, one mean inverse distance of what is seen. Names follow the rules of `inertial`: held-out
seconds must be explained better and all of the interval must be beyond what is usual.

Shapes: P pairs of pictures, N tracks.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core import least_squares
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.sensors import pictures, sensed, tracks, viewpoint
from nerf2real.sysid.sensors.sensed import Estimate, Part, row
from nerf2real.sysid.sensors.tracks import Tracks
from nerf2real.sysid.sensors.viewpoint import View
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

KINDS = {"camera_latency": "delay", "camera_focal": "scale"}
_USUAL = {"camera_latency": 0.012, "camera_focal": 0.03}
"""s, 1; ours: half a frame's exposure and read-out, jitter; a calibration by hand, focus."""
_NOMINAL = {"camera_latency": 0.0, "camera_focal": 1.0}
_STAMPS = 0.002  # s by which the joints' own stamps are off, as a bus cycle takes that; ours
_MOUNT = 0.05  # rad, standard deviation of a mount's rotation; ours
_NEARNESS = (0.5, 0.5)  # 1/m, mean and standard deviation of rho: a room, or the open; ours
_LATEST = (-0.1, 0.4)  # s
_MOVES = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2])  # of finite differences
_FLOOR = 0.05  # pixel: nobody tracks better
_MOST = 6000  # tracks that are looked at, of all logs
_FEWEST = 30  # pairs of pictures, of all logs
_TURN = 0.03  # rad that a camera must turn in some log


@dataclasses.dataclass(frozen=True)
class _Scene:
  """One log: what was seen and where the model's camera was."""

  view: View
  lens: Camera
  tracks: Tracks


@dataclasses.dataclass(frozen=True)
class Seen:
  """What the pictures say, and what `brightness` needs of them."""

  part: Part
  sources: list[pictures.Source]
  views: list[View]
  delay: float = 0.0
  """s, as it was fitted."""
  scale: float = 1.0
  """Of the focal length, if that is named."""


def find(model: mujoco.MjModel, logs: Sequence[Log]) -> Seen | None:
  """Returns the camera's effects; None where no log has pictures.

  Where pictures cannot be used the effects are empty and a note says why.
  """
  filmed = with_pictures(logs)
  if not filmed:
    return None
  try:
    sources, views = look(model, filmed)
  except pictures.LensError as error:
    return Seen(Part(notes=[str(error)]), [], [])
  if max(view.reach() for view in views) < _TURN:
    note = "The camera does not turn in the logs: neither latency nor focal length shows."
    return Seen(Part(notes=[note]), sources, views)
  scenes = []
  for log, source, view in zip(filmed, sources, views, strict=True):
    found = tracks.follow(source, log.duration)
    scenes.append(_Scene(view, source.lens, _within(found, view, _MOST // len(filmed))))
  if sum(len(s.tracks.first) for s in scenes) < _FEWEST:
    note = "The pictures have too few features to follow: neither latency nor focal length shows."
    return Seen(Part(notes=[note]), sources, views)
  part, delay = _judge(
    _Problem(scenes), model.camera(viewpoint.choose(model, sources[0].frame)).name
  )
  scales = [r["parameters"]["scale"]["value"] for r in part.rows if r["kind"] == "camera_focal"]
  return Seen(part, sources, views, delay, *scales)


def with_pictures(logs: Sequence[Log]) -> list[Log]:
  """Returns the logs whose files hold pictures and are whole."""
  whole = [log for log in logs if log.path is not None and not log.recovered]
  return [log for log in whole if log.pictures]


def look(model: mujoco.MjModel, logs: Sequence[Log]) -> tuple[list[pictures.Source], list[View]]:
  """Returns pictures and the camera's poses of logs.

  Raises:
    pictures.LensError: the lens is unknown, or the model's camera or its motion is.
  """
  sources, views = [], []
  for log in logs:
    assert log.path is not None
    source = pictures.source(log.path, log.start_ns)
    camera = viewpoint.choose(model, source.frame)
    if camera is None:
      names = [model.camera(i).name for i in range(model.ncam)]
      raise pictures.LensError(
        f"{log.name} has pictures of {source.frame!r}, the model has the cameras {names}: name the "
        "model's camera like the pictures' frame_id."
      )
    missing = viewpoint.unmeasured(model, camera, log.joints)
    if missing:
      raise pictures.LensError(
        f"{log.name} has pictures, but what moves the camera was not measured: {missing}; hold the "
        "robot's base still and give a model that is fixed there."
      )
    sources.append(source)
    views.append(viewpoint.along(model, log, camera))
  return sources, views


def _within(found: Tracks, view: View, most: int) -> Tracks:
  """Returns the tracks of pairs whose poses are known at any delay, `most` of them at the most."""
  inside = (found.first > view.time[0] + _LATEST[1]) & (found.second < view.time[-1] + _LATEST[0])
  kept = np.flatnonzero(inside[found.pair]) if len(found.pair) else found.pair
  kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), most)).astype(int)]
  pairs, index = np.unique(found.pair[kept], return_inverse=True)
  return Tracks(
    found.first[pairs], found.second[pairs], index, found.before[kept], found.after[kept]
  )


class _Problem:
  """The tracks of all logs and what they should have done.

  Values are [delay, log scale, mount (3), rho]; a hypothesis frees delay, scale, both or none.
  """

  def __init__(self, scenes: Sequence[_Scene]):
    self.scenes = [s for s in scenes if len(s.tracks.pair)]
    counts = np.cumsum([0, *(len(s.tracks.first) for s in self.scenes)])
    self.pair = np.concatenate(
      [s.tracks.pair + c for s, c in zip(self.scenes, counts, strict=False)]
    )
    blocks, first = [], 0
    for s in self.scenes:
      own = np.floor((s.tracks.first - s.tracks.first[0]) / SETTINGS.block_s).astype(int)
      blocks.append(own + first)
      first += int(own.max()) + 1
    self.block = np.concatenate(blocks)[self.pair]
    """[N], second that a track is in."""
    self.prior = np.array([0, 0, *(1 / _MOUNT,) * 3, 1 / _NEARNESS[1]])
    self.noise = 1.0
    """Pixel: of a pair, of which all tracks count as one."""

  def residual(self, x: Array) -> Array:
    """Returns seen minus expected places of all tracks [N, 2], pixel."""
    return np.concatenate([_residual(s, x) for s in self.scenes])

  def jacobian(self, x: Array, free: Array, base: Array) -> Array:
    """Returns derivatives of the residual [n, N, 2] by the free values."""
    steps = np.diag(_MOVES)[free]
    return np.stack([(self.residual(x + s) - base) / s.max() for s in steps])

  def weight(self, base: Array) -> Array:
    """Returns weights [N, 1]: robust, tracks of a pair count as one, all in units of noise."""
    alike = np.sqrt(len(self.pair) / (self.pair[-1] + 1))
    size = np.linalg.norm(base, axis=1, keepdims=True) / self.noise
    return least_squares.cauchy_weights(size, sensed.SOFT) / (self.noise * alike)

  def fit(self, free: Array, start: Array, chosen: Array, steps: int = sensed.STEPS) -> Array:
    """Returns the values that explain the chosen tracks best."""
    x = start.copy()
    for _ in range(steps):
      base = self.residual(x)
      jacobian = self.jacobian(x, free, base)[:, chosen]
      weight = self.weight(base)[chosen]
      step = least_squares.gauss_newton_step(
        jacobian * weight,
        base[chosen] * weight,
        prior_precision=self.prior[free] ** 2 + 1e-9,
        prior_offset=(x - _START)[free],
      )
      x[free] -= step
      x[0], x[5] = np.clip(x[0], *_LATEST), max(x[5], 0.0)
      x[1] = np.clip(x[1], -0.7, 0.7)
      if np.all(np.abs(step) < 0.1 * _MOVES[free]):
        break
    return x

  def score(self, names: Sequence[str]) -> tuple[float, Array]:
    """Returns the logarithm of the error on held-out seconds [pixel], and the values of all."""
    free = _free(names)
    every = np.ones(len(self.pair), bool)
    start = _START.copy()
    if "camera_latency" in names:
      start[0] = self._late()
    whole = self.fit(free, start, every)
    squares = []
    for chosen in (self.block % 2 == 0, self.block % 2 == 1):
      x = self.fit(free, whole, chosen, steps=3)
      squares.append(self._of_pairs(self.residual(x), ~chosen))
    # Not the worst: somebody walks by.
    ordered = np.sort(np.concatenate(squares))
    mean = np.mean(ordered[: max(1, int(0.98 * len(ordered)))])
    return 0.5 * float(np.log(mean + _FLOOR**2)), whole

  def _of_pairs(self, residual: Array, chosen: Array) -> Array:
    """Returns the squared median error of pairs [pixel^2]."""
    size, pair = np.linalg.norm(residual[chosen], axis=1), self.pair[chosen]
    cuts = np.flatnonzero(np.diff(pair)) + 1
    return np.array([np.median(part) ** 2 for part in np.split(size, cuts)])

  def _late(self) -> float:
    """Returns the delay that fits best by itself: the error has a valley a period of the motion."""
    tried = np.arange(_LATEST[0], _LATEST[1], 0.02)
    errors = [np.mean(np.abs(self.residual(np.append(late, _START[1:])))) for late in tried]
    return float(tried[int(np.argmin(errors))])

  def spread(self, names: Sequence[str], x: Array) -> Array:
    """Returns standard deviations [6], from the scatter over whole seconds; 0 of what is fixed."""
    free = _free(names)
    base = self.residual(x)
    weight = self.weight(base)
    found = least_squares.block_covariance(
      self.jacobian(x, free, base) * weight,
      base * weight,
      self.block,
      prior=np.diag(self.prior[free] ** 2),
    )
    result = np.zeros(6)
    result[free] = least_squares.standard_deviations(found)
    return result


_START = np.array([0.0, 0.0, 0.0, 0.0, 0.0, _NEARNESS[0]])


def _free(names: Sequence[str]) -> Array:
  """Returns the indices of the values that a hypothesis fits."""
  own = [i for i, kind in enumerate(KINDS) if kind in names]
  return np.array([*own, 2, 3, 4, 5])


def _residual(scene: _Scene, x: Array) -> Array:
  """Returns seen minus expected places of a log's tracks [N, 2], pixel."""
  t, scale, mount = scene.tracks, float(np.exp(x[1])), Rotation.from_rotvec(x[2:5])
  lens = dataclasses.replace(scene.lens, fx=scene.lens.fx * scale, fy=scene.lens.fy * scale)
  first, second = t.first - x[0], t.second - x[0]
  back = (scene.view.rotation(second) * mount).inv()
  turn = (back * scene.view.rotation(first) * mount).as_matrix()[t.pair]
  shift = back.apply(scene.view.position(first) - scene.view.position(second))[t.pair]
  rays = lens.rays(t.before)
  rays /= np.linalg.norm(rays, axis=1, keepdims=True)
  expected = np.einsum("nij,nj->ni", turn, rays) + x[5] * shift
  expected[:, 2] = np.maximum(expected[:, 2], 1e-2)
  return t.after - lens.project(expected)


def _judge(problem: _Problem, camera: str) -> tuple[Part, float]:
  """Returns what is named, and the delay as fitted [s]."""
  names = tuple(KINDS)
  for _ in range(2):  # the noise is what the best hypothesis leaves
    full, fitted = problem.score(names)
    problem.noise = max(float(np.exp(full)), _FLOOR)
  bare, _ = problem.score(())
  spread = problem.spread(names, fitted)
  part = Part(before=float(np.exp(bare)), after=float(np.exp(bare)))
  part.estimates = {
    (kind, KINDS[kind]): Estimate(*_value(kind, fitted, spread), _USUAL[kind]) for kind in names
  }
  for kind in names:
    rest = tuple(n for n in names if n != kind)
    gain = problem.score(rest)[0] - full
    value, low, high = _value(kind, fitted, spread)
    if gain > sensed.GAIN and _sure(kind, low, high):
      part.rows.append(row(kind, camera, {KINDS[kind]: (value, low, high)}, gain, bare - full))
  if not part.rows and bare - full > sensed.GAIN:
    for kind in names:
      alone, x = problem.score((kind,))
      value, low, high = _value(kind, x, problem.spread((kind,), x))
      if alone - full < sensed.GAIN and _sure(kind, low, high):
        found = row(kind, camera, {KINDS[kind]: (value, low, high)}, bare - alone, bare - full)
        part.alternatives.append(found)
  _, low, high = _value("camera_latency", fitted, spread)
  if high < -_USUAL["camera_latency"]:
    part.notes.append(
      f"The pictures of {camera!r} are ahead of the joints by {-fitted[0]:.3f} s: their stamps are "
      "of another clock, or the joints' readings are late."
    )
  if part.rows:
    part.after = float(np.exp(problem.score(tuple(r["kind"] for r in part.rows))[0]))
  return part, float(fitted[0])


def _value(kind: str, x: Array, spread: Array) -> tuple[float, float, float]:
  """Returns a kind's value with its interval."""
  index = list(KINDS).index(kind)
  reach = sensed.SIGMAS * spread[index]
  if kind == "camera_latency":
    reach = np.hypot(reach, _STAMPS)
  ends: list[Any] = [x[index] + s * reach for s in (0, -1, 1)]
  value, low, high = (float(np.exp(e)) if kind == "camera_focal" else float(e) for e in ends)
  return value, low, high


def _sure(kind: str, low: float, high: float) -> bool:
  """Tells whether all of an interval is beyond what is usual; pictures are never early."""
  nominal, usual = _NOMINAL[kind], _USUAL[kind]
  return low > nominal + usual or (high < nominal - usual and kind != "camera_latency")
