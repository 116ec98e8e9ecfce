"""Observation normalisation: every column of the inputs by its mean and standard deviation.

x' = (x - mean) / std, measured once on the data that first fill the replay and constant from then
on, so that neither networks nor targets see their inputs move. A column's deviation counts as a
tenth of its observation's RMS at least, and as 0.001: a column that hardly varied in the data must
not be magnified without bound. The exported policy has the scaling folded into its first layer:
W' = W / std, b' = b - (mean / std) W; NumPy, actors and the robot compute what they did before.

Shape letters: N rows, S proprioception, P privileged, C columns.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.specs import Layout

Params = dict[str, Any]

_MIN_STDDEV = 1e-3  # chosen: below what any sensor here resolves
_MIN_SHARE = 0.1  # of the RMS deviation of the observation's columns; chosen: see above
NAMES = ("state", "privileged")  # as in a trajectory


def identity(layout: Layout) -> Params:
  """The scaling before anything was measured: {"state": {"mean" [S], "stddev" [S]}, ...}.

  Kinds of observation that the environment does not have are left out.
  """
  sizes = (layout.state_size, layout.privileged_size)
  return {
    name: {"mean": np.zeros(size, np.float32), "stddev": np.ones(size, np.float32)}
    for name, size in zip(NAMES, sizes, strict=True)
    if size
  }


def is_measured(scaling: Params) -> bool:
  """Whether a scaling is more than the identity; True where there is none to be measured."""
  return not scaling or any(np.any(np.asarray(s["stddev"]) != 1) for s in scaling.values())


def measure(rows: Mapping[str, np.ndarray], layout: Layout) -> Params:
  """Measures the scaling on data.

  Args:
    rows: `state` [N, S] and `privileged` [N, P].
    layout: the environment's layout.
  """
  sizes = (layout.state_sizes, layout.privileged_sizes)
  return {
    name: _measure(rows[name], np.array([n for n in groups if n]))
    for name, groups in zip(NAMES, sizes, strict=True)
    if any(groups)
  }


def _measure(rows: np.ndarray, groups: np.ndarray) -> Params:
  """Mean and bounded deviation of columns [C] that belong to observations of these sizes."""
  wide = np.asarray(rows, np.float64)
  mean, stddev = wide.mean(0), wide.std(0)
  starts = np.cumsum(groups) - groups
  rms = np.sqrt(np.add.reduceat(stddev**2, starts) / groups)
  floor = np.repeat(rms, groups) * _MIN_SHARE
  bounded = np.maximum(np.maximum(stddev, floor), _MIN_STDDEV)
  return {"mean": mean.astype(np.float32), "stddev": bounded.astype(np.float32)}


def apply(scaling: Params, name: str, values: Any) -> Any:
  """Scales values [..., C] of `state` or `privileged`; unchanged where there is no scaling."""
  if name not in scaling:
    return values
  return (values - scaling[name]["mean"]) / scaling[name]["stddev"]


def fold(policy: Params, scaling: Params) -> Params:
  """A policy for observations as they are, from one for scaled observations."""
  if "state" not in scaling:
    return policy
  mean, stddev = (np.asarray(scaling["state"][name]) for name in ("mean", "stddev"))
  return _with_first_layer(policy, 1 / stddev, -mean / stddev)


def unfold(policy: Params, scaling: Params) -> Params:
  """A policy for scaled observations, from one for observations as they are: undoes `fold`."""
  if "state" not in scaling:
    return policy
  mean, stddev = (np.asarray(scaling["state"][name]) for name in ("mean", "stddev"))
  return _with_first_layer(policy, stddev, mean)


def _with_first_layer(policy: Params, factor: np.ndarray, shift: np.ndarray) -> Params:
  """Replaces the first layer's inputs x by factor * x + shift; the picture's come before them."""
  layer = policy["mlp"]["layer0"]
  weights, bias = np.array(layer["w"]), np.asarray(layer["b"])
  first = weights.shape[0] - len(factor)
  bias = bias + shift @ weights[first:]
  weights[first:] *= factor[:, None]
  return policy | {"mlp": policy["mlp"] | {"layer0": {"w": weights, "b": bias}}}
