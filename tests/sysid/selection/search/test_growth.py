"""Sets of effects that are found one by one, and what single steps do not lead to."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.search import explain, growth, rivals
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of

KINDS = ("command_delay", "coulomb_friction", "motor_gain", "viscous_friction")


@pytest.fixture(scope="module")
def explainer():
  hidden = [
    Effect("coulomb_friction", "joint", {"torque": 0.3}),
    Effect("motor_gain", "joint", {"gain": 1.3, "scales_limit": 1.0}),
  ]
  return _explainer(hidden, KINDS)


def _explainer(hidden, kinds):
  """Returns one of a pendulum that has effects, and a library of some kinds."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = [log_of(PENDULUM, kind, hidden, duration=5.0) for kind in ("sweep", "slow")]
  plant = JointModel(model, "joint", logs)
  library = candidates.library(plant)
  library.append(candidates.cogging(plant, signatures.waves(plant)))
  own = [t for t in library if t.kind in kinds]
  return Explainer(JointLikelihood(plant, settings=SETTINGS), constants(plant), own)


def _of(explainer, *kinds):
  """Returns the hypothesis of some kinds, each in its first form from its first start."""
  terms = [next(t for t in explainer.library if t.kind == kind) for kind in kinds]
  chosen = (*explainer.base, *terms)
  x = np.concatenate([explainer.null.fit.x, *[t.starts[0] for t in terms]])
  return explainer.score(chosen, Fitter([explainer.joint], Layout([chosen])).fit(x, iterations=6))


def test_a_gain_begins_with_the_other_torques_larger_by_as_much(explainer):
  parent = _of(explainer, "command_delay", "coulomb_friction")
  gain = next(t for t in explainer.library if t.kind == "motor_gain")
  begun = explain._scaled(parent, gain)
  assert [row[-1] for row in begun] == [s[0] for s in gain.starts]
  before = parent.fit.x
  for row in begun:
    assert row[-2] == pytest.approx(before[-1] * row[-1])  # friction
    assert row[:-2] == pytest.approx(before[:-1])  # constants and a delay
  assert explain._scaled(parent, next(t for t in explainer.library if t.kind != "motor_gain")) == []
  assert explain._scaled(explainer.null, gain) == []  # nothing to scale


def test_what_constants_have_taken_in_common_of_a_weak_motor_begins_as_its_gain():
  weak = _explainer([Effect("motor_gain", "joint", {"gain": 0.93, "scales_limit": 1.0})], KINDS)
  gain, other = (
    next(t for t in weak.library if (t.kind == "motor_gain") is is_gain)
    for is_gain in (True, False)
  )
  (begun,) = explain._in_common(weak.null, gain)
  assert begun[-1] == pytest.approx(0.93, abs=0.03)
  shares = [weak.base[0].names.index(name) for name in ("damping", "armature", "mass")]
  assert np.abs(begun[shares]).max() < 0.5 * np.abs(weak.null.fit.x[shares]).max()
  assert explain._in_common(weak.null, other) == []
  assert explain._in_common(_of(weak, "coulomb_friction"), gain) == []


def test_an_effect_that_was_chosen_too_early_is_exchanged(explainer):
  begun = _of(explainer, "coulomb_friction", "viscous_friction")
  found = growth._exchanged(explainer, begun)
  assert found.names == {"coulomb_friction", "motor_gain"}
  left = [np.sqrt(np.median(s.fit.held[0][0])) for s in (found, begun)]
  assert left[0] < 0.5 * left[1]
  assert found.values("motor_gain")["gain"] == pytest.approx(1.3, rel=0.05)
  assert found.values("coulomb_friction")["torque"] == pytest.approx(0.3, rel=0.1)


def test_one_effect_is_exchanged_for_none(explainer):
  single = _of(explainer, "viscous_friction")
  assert growth._exchanged(explainer, single) is single


def test_what_a_rival_has_besides_is_tried_beside_the_best_hypothesis(explainer):
  """A delay and friction, beside a gain: the gain with each of them tells what it is worth."""
  best = _of(explainer, "motor_gain")
  rival = _of(explainer, "command_delay", "coulomb_friction")
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
  explainer = _explainer(hidden, ("load_friction", "motor_gain"))
  (single,) = (s for s in explainer.extend(explainer.null, 2) if s.names == {"load_friction"})
  assert dict(single.terms[-1].fixed)["carried"] != 2.0
  alone, among = (
    explainer.extend(single, 1, only="motor_gain", forms=forms)[0] for forms in (False, True)
  )
  assert dict(among.terms[1].fixed)["carried"] == 2.0
  left = [np.sqrt(np.median(s.fit.held[0][0])) for s in (among, alone)]
  assert left[0] < 0.5 * left[1]
  assert among.values("load_friction")["coefficient"] == pytest.approx(0.4, rel=0.1)


def test_cogging_is_read_off_what_the_effects_beside_it_leave():
  hidden = [
    Effect("torque_limit", "joint", {"limit": 1.2}),
    Effect("cogging", "joint", {"amplitude": 0.06, "periods": 7.5, "phase": -2.0}),
  ]
  explainer = _explainer(hidden, ("torque_limit", "cogging"))
  limited = _of(explainer, "torque_limit")
  wave = next(t for t in explainer.library if t.kind == "cogging")
  assert min(abs(s[1] - 7.5) for s in wave.starts) > 1.0  # the limit hides it
  assert min(abs(s[1] - 7.5) for s in explainer._waves(limited, wave)) < 0.5
  assert explainer._waves(explainer.null, wave) == []
  (found,) = explainer.extend(limited, 1, only="cogging")
  assert found.values("cogging")["periods"] == pytest.approx(7.5, rel=0.02)


def test_a_hypothesis_is_taken_over_with_its_values(explainer):
  grown = growth._exchanged(explainer, _of(explainer, "coulomb_friction", "viscous_friction"))
  plant = explainer.joint.plant
  other = Explainer(
    JointLikelihood(plant, settings=SETTINGS), explainer.constants, explainer.library
  )
  taken = other.take_over(grown)
  assert taken.terms == grown.terms and taken in other.scored.values()
  for kind, values in {"motor_gain": {"gain": 1.3}, "coulomb_friction": {"torque": 0.3}}.items():
    assert taken.values(kind) == pytest.approx(values, rel=0.1)


def test_cogging_begins_where_a_shifted_zero_has_moved_it(explainer):
  plant = explainer.joint.plant
  wave = candidates.cogging(plant, [(0.01, 20.0, 1.0)])
  zero = next(t for t in candidates.library(plant) if t.kind == "encoder_offset")
  starts = np.array([[0.01, 20.0, 1.0, 0.15], [0.01, 20.0, 1.0, 0.0]])
  begun = explain._moved((wave, zero), starts)
  assert begun[:2] == pytest.approx(starts)
  assert begun[2:] == pytest.approx(np.array([[0.01, 20.0, 4.0 - 2 * np.pi, 0.15], starts[1]]))
  read = np.linspace(-1.0, 1.0, 50)  # the encoder reads the zero more than the joint is at
  assert np.sin(20.0 * (read - 0.15) + begun[2, 2]) == pytest.approx(np.sin(20.0 * read + 1.0))
  alone = starts[:, :3]
  assert explain._moved((wave,), alone) is alone


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
