"""Sets of effects that are found one by one, and what single steps do not lead to."""

import dataclasses

import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.selection.search import growth, rivals
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.search.explainers import explainer_of, fitted


def _extended(explainer, item):
  """Returns the hypotheses that lack one of the effects of another."""
  return {rivals.lacking(explainer, item, kind).terms for kind in item.names}


def test_an_effect_that_was_chosen_too_early_is_exchanged(explainer):
  """Unless all that may stand in its place has been tried."""
  begun = fitted(explainer, "coulomb_friction", "viscous_friction")
  assert growth._exchanged(explainer, begun, _extended(explainer, begun)) is begun
  found = growth._exchanged(explainer, begun, set())
  assert found.names == {"coulomb_friction", "motor_gain"}
  left = [np.sqrt(np.median(s.fit.held[0][0])) for s in (found, begun)]
  assert left[0] < 0.5 * left[1]
  assert found.values("motor_gain")["gain"] == pytest.approx(1.3, rel=0.05)
  assert found.values("coulomb_friction")["torque"] == pytest.approx(0.3, rel=0.1)


def test_one_effect_is_exchanged_for_none(explainer):
  single = fitted(explainer, "viscous_friction")
  assert growth._exchanged(explainer, single, set()) is single


def test_what_a_rival_has_besides_is_tried_beside_the_best_hypothesis(explainer):
  """A delay and friction, beside a gain: the gain with each of them tells what it is worth."""
  best = fitted(explainer, "motor_gain")
  rival = fitted(explainer, "command_delay", "coulomb_friction")
  both = [{"motor_gain", kind} for kind in rival.names]
  for terms in [terms for terms, s in explainer.scored.items() if s.names in both]:
    del explainer.scored[terms]
  assert rivals.with_anothers(explainer, best, [rival])
  late, rubbing = (
    next(s for s in explainer.scored.values() if s.names == {"motor_gain", kind})
    for kind in ("command_delay", "coulomb_friction")
  )
  assert rubbing.evidence > max(best.evidence, late.evidence)  # friction is there, a delay is not
  assert not rivals.with_anothers(explainer, best, [rival])  # all are scored


def test_a_form_that_is_worse_alone_is_found_beside_another_effect():
  """Friction of what the link takes, in a weak motor: alone that of all torques looks likelier."""
  hidden = [
    Effect("load_friction", "joint", {"coefficient": 0.4, "carried": 2.0}),
    Effect("motor_gain", "joint", {"gain": 0.69, "scales_limit": 1.0}),
  ]
  explainer = explainer_of(hidden, ("load_friction", "motor_gain"))
  (single,) = (s for s in explainer.extend(explainer.null, 2) if s.names == {"load_friction"})
  assert dict(single.terms[-1].fixed)["carried"] != 2.0
  alone, among = (
    explainer.extend(single, 1, only="motor_gain", forms=forms)[0] for forms in (False, True)
  )
  assert dict(among.terms[1].fixed)["carried"] == 2.0
  left = [np.sqrt(np.median(s.fit.held[0][0])) for s in (among, alone)]
  assert left[0] < 0.5 * left[1]
  assert among.values("load_friction")["coefficient"] == pytest.approx(0.4, rel=0.1)


def test_a_hypothesis_is_taken_over_with_its_values(explainer):
  begun = fitted(explainer, "coulomb_friction", "viscous_friction")
  grown = growth._exchanged(explainer, begun, set())
  plant = explainer.joint.plant
  other = Explainer(
    JointLikelihood(plant, settings=SETTINGS), explainer.constants, explainer.library
  )
  taken = other.take_over(grown)
  assert taken.terms == grown.terms and taken in other.scored.values()
  for kind, values in {"motor_gain": {"gain": 1.3}, "coulomb_friction": {"torque": 0.3}}.items():
    assert taken.values(kind) == pytest.approx(values, rel=0.1)


def test_a_late_command_is_near_one_of_the_starts(explainer):
  (starts,) = {t.starts for t in explainer.library if t.kind == "command_delay"}
  values = np.array(starts)[:, 0]
  assert values[0] < 0.005 and values[-1] > 0.15
  assert np.all(values[1:] / values[:-1] < 1.4)


def test_what_a_reference_shows_of_an_effect_may_be_larger_or_of_another_form(explainer):
  """A load friction that a reference shows is tried with its own size, others, and other forms."""
  forms = [t for t in candidates.library(explainer.joint.plant) if t.kind == "load_friction"]
  known = dataclasses.replace(
    forms[0], prior=(0.01,), centre=(0.05,), starts=((0.05,),), known=True
  )
  library = [*forms, *explainer.library]
  own = Explainer(explainer.joint, explainer.constants, library, known=[known])
  size = own.null.fit.x[-1]
  tried = {
    terms[-1].fixed: starts[:, -1]
    for terms, starts, *_ in own._candidates(own.null)
    if terms[-1].kind == "load_friction" and len(terms) == 2
  }
  assert set(tried) == {t.fixed for t in forms}
  usual = [s[0] for s in forms[0].starts]
  assert tried[known.fixed] == pytest.approx([*usual, size, 0.5 * size, 1.5 * size, 3.0 * size])
  assert all(tried[t.fixed] == pytest.approx(usual) for t in forms[1:])
