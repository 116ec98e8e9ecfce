"""One joint of a model along measured logs, as the compiled kernel simulates it: in open loop from
the commands, or with its state pulled to the readings.

What masses and gravity add is linear and kept on the step grid as the kernel takes it, so that a
hypothesis costs a product, not a pass over the model. Shapes: N samples of a log, T grid points, P
kernel parameters, K parts of a basis.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.model.plant import (
  JointPlant,
  Simulated,
  declared_parameters,
  turned_back,
  turning,
)
from nerf2real.sysid.model.reduction import Reduction, Surroundings
from nerf2real.sysid.model.servo.law import ServoLaw, servo_law

Array = np.ndarray
I = kernel.INDEX  # noqa: E741

FOLLOWED_S = 0.02
"""s in which a state that follows the readings makes up for a difference."""


_ZERO_OF = "zero of "  # begins the key of what another joint's shifted zero adds
_NEAR = 0.1  # s on either side of a sample over which an error is averaged; chosen
_KEPT = 2  # sets of loads of a log whose fields are kept: a fit's and that of a difference to it


class Load(NamedTuple):
  """A linear change of what a joint feels: factors of the parts of a basis."""

  key: str
  """"mass", "gravity", the name of a body that carries more, or `zero_load`'s of another joint."""
  factors: Array


Table = tuple[Array, Array]
"""Weights [Q, V] of a force over position and velocity, and its bounds [4]."""


class JointModel(JointPlant):
  """A joint of a declared model and what several logs hold of it."""

  def __init__(
    self,
    model: mujoco.MjModel,
    joint: str,
    logs: Sequence[Log],
    *,
    reductions: Sequence[Reduction] | None = None,
    window_s: float = 0.5,
  ):
    super().__init__(model, joint, logs, reductions=reductions, window_s=window_s)
    self._bases: dict[str, list[Array]] = {}
    self._unloaded = [np.array(turning(fields, self.hinge)) for fields in self._nominal]
    self._loaded: dict[int, dict[tuple, tuple[Array, ...]]] = {}
    self._missed: dict[int, Array] = {}
    periods = np.concatenate([np.diff(log.time) for log in self.logs])
    period = max(float(np.median(periods)), 1e-6)
    share = 1.0 - float(np.exp(-period / FOLLOWED_S))
    self._follow = share, share**2 / (2.0 - share) / period  # Benedict and Bordner 1962

  def basis(self, key: str) -> list[Array]:
    """Returns the parts [K, 4, T] of a basis, one array a log, in the rows of `forces`."""
    if key not in self._bases:
      if key == "mass":
        self._bases[key] = [fields[None] for fields in self._unloaded]
      elif key == "gravity":
        self._bases[key] = self._parts([r.gravity(self.joint) for r in self.reductions])
      elif key.startswith(_ZERO_OF):
        other = key.removeprefix(_ZERO_OF)
        self._bases[key] = self._parts([r.zero(self.joint, other) for r in self.reductions])
      else:
        body = self._body(key)
        self._bases[key] = self._parts([r.moments(self.joint, body) for r in self.reductions])
    return self._bases[key]

  def _parts(self, logs: Sequence[Sequence[Surroundings]]) -> list[Array]:
    return [
      np.array([turning((p.inertia, p.here, p.across, at, p.bias), self.hinge) for p in parts])
      for parts, (_, _, _, at, _) in zip(logs, self._nominal, strict=True)
    ]

  @functools.cached_property
  def law(self) -> tuple[ServoLaw, Array] | None:
    """The law of its servo and what that leaves of the duty [N], where logs hold it."""
    return servo_law(self)

  def reduction_error(self, index: int) -> Array:
    """Returns how far off a log's simulation is as its other joints are prescribed [N], rad (or m).

    The root of the mean square over `_NEAR` s, of the declared machine's own recording.
    """
    if index not in self._missed:
      self._missed[index] = self._missed_in(index)
    return self._missed[index]

  def _missed_in(self, index: int) -> Array:
    twin = self.reductions[index].twin
    time = self.logs[index].time
    if twin is None:
      return np.zeros(len(time))
    reduction, course = twin
    plant = JointModel(self.model, self.joint, [reduction.log], reductions=[reduction])
    got = plant.run(plant.declared, (), 0).position
    squares = np.square(got - course[:, reduction.log.states.column(self.joint)])
    total = np.append(0.0, np.cumsum(squares))
    first, last = np.searchsorted(time, time - _NEAR), np.searchsorted(time, time + _NEAR, "right")
    return np.sqrt((total[last] - total[first]) / (last - first))

  def tilt_load(self, x: float, y: float) -> Load:
    """Returns what turning gravity by the rotation vector (x, y, 0) adds."""
    before = self.model.opt.gravity
    return Load("gravity", matrix_from_rotvec([x, y, 0.0]) @ before - before)

  def simulated_by(self, numerics: Numerics) -> "JointModel":
    """Returns the same joint with other numerics, whose step is an equal part of this one's."""
    result = copy.copy(self)
    result.model, result.step = copy.copy(self.model), numerics.step
    numerics.apply(result.model)
    result.declared = declared_parameters(result.model, self.joint)
    result.impedance = float(result.model.dof_solimp[self.model.joint(self.joint).dofadr[0], 1])
    parts = round(self.step / numerics.step)
    result._grids = [result.step * np.arange(parts * (len(grid) - 1) + 1) for grid in self._grids]
    grids = list(zip(result._grids, self._grids, strict=True))

    def between(logs: Sequence[Any]) -> list[tuple[Array, ...]]:
      return [
        tuple(np.interp(fine, grid, row) for row in rows)
        for (fine, grid), rows in zip(grids, logs, strict=True)
      ]

    result._loads = [rows[0] for rows in between([[load] for load in self._loads])]
    result._nominal = between(self._nominal)  # type: ignore[assignment]
    if all(lift is not None for lift in self._lifts):
      result._lifts = between(self._lifts)  # type: ignore[assignment]
    result._unloaded = [np.array(rows) for rows in between(self._unloaded)]
    result._bases, result._loaded, result._missed = {}, {}, {}
    return result

  @property
  def among_others(self) -> bool:
    """Whether other joints move beside it."""
    return len(self.reductions[0].log.joints) > 1

  def zero_load(self, joint: str, offset: float) -> Load:
    """Returns what an offset of a joint's readings, rad (or m), adds to what this one feels."""
    return Load(f"{_ZERO_OF}{joint}", np.array([offset, offset**2]))

  def forces(self, loads: Sequence[Load], index: int) -> tuple[Array, ...]:
    """Returns what a log's joint feels as the kernel takes it, each [T]: inertia, gravity's torque
    at position 0 and a quarter turn further, not lifted by firmware, and bias. Those of the last
    loads are kept."""
    key = tuple((load.key, load.factors.tobytes()) for load in loads)
    kept = self._loaded.setdefault(index, {})
    if key not in kept:
      while len(kept) >= _KEPT:
        kept.pop(next(iter(kept)), None)
      changes = [np.tensordot(load.factors, self.basis(load.key)[index], 1) for load in loads]
      kept[key] = tuple(sum(changes, self._unloaded[index]))
    return kept[key]

  def at_samples(self, loads: Sequence[Load], index: int, *, offset: float = 0.0) -> Array:
    """Returns inertia, gravity's torque here and a quarter turn further, the position where that
    is, and bias, at the samples [5, N]; see `forces` and `lift`."""
    inertia, zero, quarter, bias = self.forces(loads, index)
    lift = self.lift(index, offset)
    if lift is not None:
      zero, quarter = zero - lift[0], quarter - lift[1]
    at = self._nominal[index][3]
    here, across = turned_back(zero, quarter, at) if self.hinge else (zero, quarter)
    grid, time = self._grids[index], self.logs[index].time
    return np.array([np.interp(time, grid, row) for row in (inertia, here, across, at, bias)])

  def run(
    self,
    p: Array,
    loads: Sequence[Load],
    index: int,
    *,
    table: Table | None = None,
    follow: bool = False,
    readings: Array | None = None,
  ) -> Simulated:
    """Simulates one log.

    Args:
      p: kernel parameters [P].
      loads: what changes of masses and gravity.
      index: of the log.
      table: a force over position and velocity.
      follow: whether the state is pulled to the readings.
      readings: other ones [N] than the log's.
    """
    return self.prepared(p, loads, index, table=table, follow=follow, readings=readings)()

  def prepared(
    self,
    p: Array,
    loads: Sequence[Load],
    index: int,
    *,
    table: Table | None,
    follow: bool,
    readings: Array | None = None,
  ) -> Callable[[], Simulated]:
    """Returns a simulation of one log that may run beside others; see `run`."""
    if follow:
      p = p.copy()
      p[I["follow"]], p[I["follow_speed"]] = self._follow
    return functools.partial(self._run, p, index, self.forces(loads, index), table, readings)
