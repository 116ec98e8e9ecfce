"""Where the search for one effect more begins: at the parent's motion, told with the effect."""

import dataclasses

import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.selection.search.beginnings import (
  _handed_over,
  _in_common,
  _moved,
  _scaled,
  _waves,
)
from tests.sysid.selection.search.explainers import KINDS, explainer_of, fitted


def test_a_gain_begins_with_the_other_torques_larger_by_as_much(explainer):
  parent = fitted(explainer, "command_delay", "coulomb_friction")
  gain = next(t for t in explainer.library if t.kind == "motor_gain")
  begun = _scaled(parent, gain)
  assert [row[-1] for row in begun] == [s[0] for s in gain.starts]
  before = parent.fit.x
  for row in begun:
    assert row[-2] == pytest.approx(before[-1] * row[-1])  # friction
    assert row[:-2] == pytest.approx(before[:-1])  # constants and a delay
  assert _scaled(parent, next(t for t in explainer.library if t.kind != "motor_gain")) == []
  assert _scaled(explainer.null, gain) == []  # nothing to scale


def test_what_constants_have_taken_in_common_of_a_weak_motor_begins_as_its_gain():
  weak = explainer_of([Effect("motor_gain", "joint", {"gain": 0.93, "scales_limit": 1.0})], KINDS)
  gain, other = (
    next(t for t in weak.library if (t.kind == "motor_gain") is is_gain)
    for is_gain in (True, False)
  )
  (begun,) = _in_common(weak.null, gain)
  assert begun[-1] == pytest.approx(0.93, abs=0.03)
  shares = [weak.base[0].names.index(name) for name in ("damping", "armature", "mass")]
  assert np.abs(begun[shares]).max() < 0.5 * np.abs(weak.null.fit.x[shares]).max()
  assert _in_common(weak.null, other) == []
  assert _in_common(fitted(weak, "coulomb_friction"), gain) == []


def test_cogging_is_read_off_what_the_effects_beside_it_leave():
  hidden = [
    Effect("torque_limit", "joint", {"limit": 1.2}),
    Effect("cogging", "joint", {"amplitude": 0.06, "periods": 7.5, "phase": -2.0}),
  ]
  explainer = explainer_of(hidden, ("torque_limit", "cogging"))
  limited = fitted(explainer, "torque_limit")
  wave = next(t for t in explainer.library if t.kind == "cogging")
  assert min(abs(s[1] - 7.5) for s in wave.starts) > 1.0  # the limit hides it
  assert min(abs(s[1] - 7.5) for s in _waves(limited, wave)) < 0.5
  assert _waves(explainer.null, wave) == []
  (found,) = explainer.extend(limited, 1, only="cogging")
  assert found.values("cogging")["periods"] == pytest.approx(7.5, rel=0.02)


def test_cogging_begins_where_a_shifted_zero_has_moved_it(explainer):
  plant = explainer.joint.plant
  wave = candidates.cogging(plant, [(0.01, 20.0, 1.0)])
  zero = next(t for t in candidates.library(plant) if t.kind == "encoder_offset")
  starts = np.array([[0.01, 20.0, 1.0, 0.15], [0.01, 20.0, 1.0, 0.0]])
  begun = _moved((wave, zero), starts)
  assert begun[:2] == pytest.approx(starts)
  assert begun[2:] == pytest.approx(np.array([[0.01, 20.0, 4.0 - 2 * np.pi, 0.15], starts[1]]))
  read = np.linspace(-1.0, 1.0, 50)  # the encoder reads the zero more than the joint is at
  assert np.sin(20.0 * (read - 0.15) + begun[2, 2]) == pytest.approx(np.sin(20.0 * read + 1.0))
  alone = starts[:, :3]
  assert _moved((wave,), alone) is alone


@pytest.mark.parametrize(
  ("kind", "constant"),
  [
    ("coulomb_friction", "friction"),
    ("viscous_friction", "damping"),
    ("payload", "mass"),
    ("command_delay", "latency"),
  ],
)
def test_what_a_constant_has_taken_is_handed_over(explainer, kind, constant):
  """The same motion, told with the effect, and a constant as it is known."""
  own = next(t for t in candidates.library(explainer.joint.plant) if t.kind == kind)
  at = explainer.base[0].names.index(constant)
  x = explainer.null.fit.x.copy()
  x[at] = 0.4 if constant != "latency" else 0.004
  parent = dataclasses.replace(
    explainer.null, fit=dataclasses.replace(explainer.null.fit, x=x), terms=explainer.base
  )
  (begun,) = _handed_over(parent, own)
  assert begun[at] == pytest.approx(explainer.null.fit.layout.centre[at])
  before = explainer.joint.residuals(parent.terms, x[None])
  told = explainer.joint.residuals((*parent.terms, own), begun[None])
  gone = explainer.joint.residuals(parent.terms, begun[None, : len(x)])
  assert np.std(told - before) < 0.1 * np.std(gone - before)
  assert _handed_over(_known(parent), own) == []


def _known(parent):
  """Returns a hypothesis with its constants as they are known."""
  fit = dataclasses.replace(parent.fit, x=parent.fit.layout.centre.copy())
  return dataclasses.replace(parent, fit=fit)
