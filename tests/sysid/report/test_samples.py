"""Joint draws of a fit's values, and of the effects that are written."""

import types

import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.report.samples import COUNT, with_samples
from nerf2real.sysid.selection.findings import Zero
from nerf2real.sysid.selection.search.explain import Scored
from tests.sysid.fit.test_likelihood import joint_of


@pytest.fixture(scope="module")
def fitted():
  """A joint with viscous friction beside its damping: of the two only the sum shows."""
  plant, joint = joint_of(effects=[Effect("viscous_friction", "joint", {"coefficient": 0.5})])
  term = next(t for t in candidates.library(plant) if t.kind == "viscous_friction")
  terms = (constants(plant), term)
  fitter = Fitter([joint], Layout([terms]))
  start = np.concatenate([terms[0].starts[0], term.starts[0]])
  joint.rescale(joint.residuals(terms, start[None])[0])
  for _ in range(3):
    fit = fitter.fit(start, iterations=3)
    joint.rescale(fit.residuals[0])
    start = fit.x
  return joint, Scored(joint, terms, fit, np.zeros(0))


def test_draws_lie_in_the_intervals_and_go_together_as_the_fit_says(fitted):
  joint, item = fitted
  drawn = intervals.draws(joint, item.fit, 2000, np.random.default_rng(0))
  assert (drawn >= item.fit.layout.low).all() and (drawn <= item.fit.layout.high).all()
  term = item.terms[1]
  (low, high) = intervals.intervals(joint, item.fit, term, own_latency=False)["coefficient"]
  own = drawn[:, item.fit.layout.spans[1][0]]
  assert 0.9 < np.mean((own > low) & (own < high)) < 0.99
  damping = drawn[:, item.terms[0].names.index("damping")]
  assert np.corrcoef(damping, own)[0, 1] < -0.8


def test_effects_get_as_many_draws_of_every_value(fitted):
  joint, item = fitted
  found = types.SimpleNamespace(
    joints=[types.SimpleNamespace(joint="joint", likelihood=joint, near=[item, item])],
    zeros={"joint": Zero(0.1, 0.02)},
  )
  claimed = [
    Effect("viscous_friction", "joint", {"coefficient": 0.5}),
    Effect("parameter_error", "joint", {"damping": 1.0, "gain": 1.0}),
    Effect("command_delay", None, {"delay": 0.01}),
    Effect("encoder_offset", "joint", {"offset": 0.1}),
  ]
  drawn = with_samples(found, claimed, np.random.default_rng(0))
  assert [sorted(e.samples) for e in drawn] == [
    *(["coefficient"], ["damping", "gain"], []),
    ["offset"],
  ]
  added, factor = drawn[0].samples["coefficient"], drawn[1].samples["damping"]
  assert len(added) == len(factor) == COUNT
  total = np.array(added) + np.array(factor)  # declared damping is 1 N m s/rad
  assert np.std(total) < 0.5 * np.std(added)
  assert np.median(total) == pytest.approx(1.5, abs=0.05)
  zero = drawn[3].samples["offset"]  # beside what the constants say of it
  assert np.mean(zero) == pytest.approx(0.1, abs=0.01)
  assert np.std(zero) == pytest.approx(0.02, rel=0.4)
