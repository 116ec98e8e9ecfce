"""What a residual looks like: torque, and what it goes with.

The residual torque is what the measured motion demands beyond what the model supplies:

    r = (I + armature) a + damping v + gravity + c - actuator(command, q, v)

Dry friction is left in, as a step at v = 0. Shapes: N samples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.sysid.hypotheses.candidates import SHORTEST
from nerf2real.sysid.hypotheses.composition import Composed, compose
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX, table_force

Array = np.ndarray

_WAVES = 3  # parts that repeat with position, at most
EDGES = 10  # samples at either end whose derivatives are one-sided


class TorqueResidual(NamedTuple):
  """Residual torque of one log and the regressors at the same samples."""

  position: Array
  velocity: Array
  torque: Array
  """What the actuator gives in the model at the measured state."""
  residual: Array


def torque_residual(plant: JointModel, hypothesis: Composed, index: int) -> TorqueResidual:
  """Returns the residual torque of a log under a hypothesis [N - 2 edges]."""
  log = plant.logs[index]
  value = dict(zip(INDEX, hypothesis.p, strict=True))
  offset = value["encoder_offset"]
  inertia, here, across, at, bias = plant.at_samples(hypothesis.loads, index, offset=offset)
  delay = value["command_delay"] + value["measurement_delay"]
  last = np.searchsorted(log.command_time, log.time - delay, side="right") - 1
  command = log.command[np.clip(last, 0, len(log.command) - 1)]
  torque = value["gain"] * (
    value["input"] * command
    + value["constant"]
    + value["position"] * log.position
    + value["velocity"] * log.velocity
  )
  torque = np.clip(torque, value["lowest"], value["highest"])
  q = log.position - offset
  gravity = here * np.cos(q - at) + across * np.sin(q - at) if plant.hinge else here
  demand = (inertia + value["armature"]) * log.acceleration
  demand = demand + value["damping"] * log.velocity + gravity + bias
  demand = demand + value["stiffness"] * (q - value["reference"]) - value["offset_force"]
  if hypothesis.table is not None:
    demand = demand - table_force(q, log.velocity, *hypothesis.table)
  inner = slice(EDGES, -EDGES)
  fields = (log.position, log.velocity, torque, torque - demand)
  return TorqueResidual(*(f[inner] for f in fields))


def waves(
  plant: JointModel, terms: Sequence[Term] = (), x: Array | None = None
) -> list[tuple[float, float, float]]:
  """Returns the strongest periodic parts of a hypothesis' residual torque over position.

  Args:
    plant: the joint with its logs.
    terms: of the hypothesis; the declared model for none.
    x: its values [n].

  Returns:
    (amplitude [N m], periods [1/rad], phase) of torque amplitude * sin(periods q + phase) that the
    model lacks, the strongest first.
  """
  held = compose(plant, terms, np.zeros(0) if x is None else x)
  parts = [torque_residual(plant, held, i) for i in range(len(plant.logs))]
  q = np.concatenate([p.position for p in parts])
  v = np.concatenate([p.velocity for p in parts])
  r = np.concatenate([p.residual for p in parts])
  fast = np.quantile(np.abs(v), 0.75)
  weight = (np.abs(v) < max(fast, 1e-9)) & (np.abs(r) < 5 * np.median(np.abs(r)) + 1e-12)
  q, v, r = q[weight], v[weight], r[weight]
  reach = max(float(np.ptp(q)), 1e-6)
  base = np.stack([np.ones_like(q), q, np.sign(v), v], axis=1)
  r = r - base @ np.linalg.lstsq(base, r, rcond=None)[0]
  # At least one wave over the range; a fifth of a wave over the range between neighbours.
  grid = np.arange(2 * np.pi / reach, min(1500 / reach, SHORTEST), 2 * np.pi / reach / 5)
  if not len(grid):  # a joint that hardly moves: the shortest wave that is looked for
    grid = np.array([SHORTEST])
  power = np.empty(len(grid))
  complex_part = np.empty(len(grid), complex)
  for i, k in enumerate(grid):
    complex_part[i] = np.mean(r * np.exp(-1j * k * q))
    power[i] = np.abs(complex_part[i])
  found = []
  for _ in range(_WAVES):
    best = int(np.argmax(power))
    z = complex_part[best]
    # r = -torque lacking? The demand exceeds the supply by what pushes along.
    amplitude, angle = 2 * abs(z), float(np.angle(z))
    # mean of A sin(kq + f) exp(-ikq) is A/2 exp(i (f - pi/2)); the missing torque is -r.
    phase = angle + np.pi / 2 + np.pi
    phase = float((phase + np.pi) % (2 * np.pi) - np.pi)
    found.append((float(amplitude), float(grid[best]), phase))
    power[np.abs(grid - grid[best]) < 2 * np.pi / reach] = 0.0
  return found
