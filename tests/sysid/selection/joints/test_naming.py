"""Which effects of a joint are named: the rule, on hypotheses whose predictions are given."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from nerf2real.sysid.fit.layout import Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.selection.joints import naming
from nerf2real.sysid.selection.joints.changed import Changed
from nerf2real.sysid.selection.search.evidence import Scored, clear
from nerf2real.sysid.settings import SETTINGS

BEYOND = (3.0, 3.0, 3.0)  # standard errors that count as clear


class _Joint:
  """A joint whose predictions are given."""

  class settings:
    alike = 0.5
    level = 0.05

  scale = np.array([1.0])
  log_of = np.repeat([0, 1, 2], 10)

  @staticmethod
  def squares(residuals):
    return residuals.reshape(1, -1, 10).var(axis=2)

  observations = np.ones((1, 30))

  @classmethod
  def alike(cls, apart):
    return JointLikelihood.alike(cls, apart)

  @classmethod
  def told_apart(cls, apart):
    return JointLikelihood.told_apart(cls, apart)


def _scored(kinds, nats, prediction=None):
  """Returns a hypothesis; those with an effect predict another motion than the one without."""
  prediction = (5.0 if kinds else 0.0) if prediction is None else prediction
  layout = Layout([()])
  residuals = [np.tile([1.0, -1.0], 150)[None] * prediction]
  fit = Fit(layout, np.zeros(0), 0.0, residuals, np.zeros((1, 0, 0)), np.zeros((1, 0)), [])
  fit.held = [np.exp(-np.asarray(nats))[None]]
  item = Scored(_Joint, (), fit, np.asarray(nats, float))
  item.__class__ = type("Named", (Scored,), {"names": frozenset(kinds)})
  return item


def test_a_name_needs_all_that_lack_it_to_be_clearly_worse():
  random = np.random.default_rng(0)
  noise = random.normal(0, 0.1, 30)
  null = _scored((), noise - 3.0)
  right = _scored(("a",), noise + random.normal(0, 0.1, 30))
  worse = _scored(("b",), noise - 1.0 + random.normal(0, 0.1, 30), prediction=10.0)
  as_good = _scored(("c",), noise - 0.001 + random.normal(0, 0.1, 30), prediction=10.0)
  assert naming.conclude(_Joint, [null, right, worse], BEYOND).named == ("a",)
  assert naming.conclude(_Joint, [null, right, worse, as_good], BEYOND).named == ()


def test_a_rival_that_predicts_the_same_is_said_beside_the_name():
  null = _scored((), np.linspace(-4, -3, 30))
  right, twin = _scored(("a",), np.linspace(0, 0.1, 30)), _scored(("b",), np.linspace(0, 0.09, 30))
  (name,) = naming.conclude(_Joint, [null, right, twin], BEYOND).names
  assert name.certain
  assert [sorted(s.names) for s in name.confounded] == [["b"]]


def test_a_rival_that_is_ahead_by_what_it_has_besides_holds_nothing_against_a_name():
  """a and b predict the same beside c, which is not clearly better; b alone was not found."""
  null = _scored((), np.linspace(-4, -3, 30))
  right = _scored(("a",), np.linspace(0, 0.1, 30))
  ahead = np.linspace(0, 0.1, 30) + 0.3 * (-1.0) ** np.arange(30) + 0.01
  with_a, with_b = (_scored((k, "c"), ahead, prediction=8.0) for k in "ab")
  alone = _scored(("c",), np.linspace(-4, -3, 30), prediction=3.0)
  ranked = [null, right, with_b, alone]
  assert naming.conclude(_Joint, ranked, BEYOND).named == ()  # b with c is another motion
  (name,) = naming.conclude(_Joint, [*ranked, with_a], BEYOND).names
  assert name.kind == "a" and name.certain
  assert [sorted(s.names) for s in name.confounded] == [["b", "c"]]
  other = _scored(("a", "c"), ahead, prediction=12.0)
  assert naming.conclude(_Joint, [*ranked, other], BEYOND).named == ()


def test_a_rival_that_is_clearly_worse_than_itself_with_the_effect_instead_is_beaten():
  """b with c is better than a alone, by c: a with c is clearly better than b with c."""
  random = np.random.default_rng(0)
  noise = random.normal(0, 0.1, 30)
  null, right = _scored((), noise - 3.0), _scored(("a",), noise)
  uneven = 0.3 * (-1.0) ** np.arange(30) + 0.01
  ahead = _scored(("b", "c"), noise + uneven, prediction=8.0)
  better = _scored(("a", "c"), noise + 1.0 + random.normal(0, 0.1, 30), prediction=12.0)
  assert naming.conclude(_Joint, [null, right, ahead], BEYOND).named == ()
  (name,) = naming.conclude(_Joint, [null, right, ahead], BEYOND).names
  assert name.ahead == (ahead,)
  beyond = (3.0, 1e3, 1e3)  # c is never clear beside a
  (name,) = naming.conclude(_Joint, [null, right, ahead, better], beyond).names
  assert name.certain and name.confounded == ()


def test_a_rival_that_needs_the_effect_beside_all_of_its_own_is_beaten():
  """b is as likely as a, by a few blocks; with a beside it it is better on all."""
  random = np.random.default_rng(0)
  noise = random.normal(0, 0.1, 30)
  few = np.where(np.arange(30) % 10 == 0, 8.0, -0.9)
  null, right = _scored((), noise - 3.0), _scored(("a",), noise)
  rival = _scored(("b",), noise + few, prediction=8.0)
  both = _scored(("a", "b"), noise + few + 0.8 + random.normal(0, 0.1, 30), prediction=9.0)
  needless = _scored(("a", "b"), noise + few + random.normal(0, 0.1, 30), prediction=8.5)
  beyond = (3.0, 1e3, 1e3)  # b is never clear beside a
  assert naming.conclude(_Joint, [null, right, rival], beyond).named == ()
  assert naming.conclude(_Joint, [null, right, rival, needless], beyond).named == ()
  assert naming.conclude(_Joint, [null, right, rival, both], beyond).named == ("a",)


def test_what_is_likelier_and_not_clear_keeps_no_clear_effect_from_being_named():
  """b explains a few blocks by far and is not clear; a is, alone and beside it."""
  small = 0.5 + 0.1 * (-1.0) ** np.arange(30)
  few = np.zeros(30)
  few[[4, 5, 17]] = 60.0, -25.0, 25.0
  null, a = _scored((), np.zeros(30)), _scored(("a",), small)
  b, both = _scored(("b",), few, prediction=9.0), _scored(("a", "b"), few + small, prediction=14.0)
  assert b.evidence > a.evidence and clear(b, null) < BEYOND[0] < clear(a, null)
  assert naming.conclude(_Joint, [null, a, b, both], BEYOND).named == ("a",)
  assert naming.conclude(_Joint, [null, a, b], BEYOND).named == ()  # b might do without it


def test_an_effect_without_which_the_same_is_predicted_is_needless():
  null = _scored((), np.linspace(-4, -3, 30))
  both = _scored(("a", "b"), np.linspace(0, 0.1, 30))
  plain = _scored(("a",), np.linspace(0, 0.1, 30) - 0.05 * (-1.0) ** np.arange(30))
  (a, b) = naming.conclude(_Joint, [null, both], BEYOND).names  # without its rival it would stand
  assert (a.certain, b.certain) == (True, True)
  a, b = (naming._name(_Joint, both, k, [null, both, plain], 3.0) for k in "ab")
  assert a.certain and a.clear > 3.0 > b.clear
  assert b.confounded == ()


def test_an_effect_beside_a_clearer_one_must_be_clear_of_all_pairs_that_were_tried():
  null = _scored((), np.linspace(-4, -3, 30))
  both = _scored(("a", "b"), np.linspace(0, 0.1, 30))
  plain = _scored(("a",), np.linspace(0, 0.1, 30) - 0.3 - 0.5 * (-1.0) ** np.arange(30), 10.0)
  behind = clear(both, plain)
  one, two, _ = naming.thresholds(20)
  assert one < behind < two, behind
  assert naming.conclude(_Joint, [null, both, plain], (one,) * 3).named == ("a", "b")
  assert naming.conclude(_Joint, [null, both, plain], (one, two, two)).named == ("a",)


def test_a_name_that_makes_one_motion_clearly_worse_does_not_stand():
  random = np.random.default_rng(0)
  noise = random.normal(0, 0.3, 30)
  null, split = _scored((), np.zeros(30)), _scored(("a",), np.repeat([4.0, 4.0, -0.8], 10) + noise)
  (name,) = naming.conclude(_Joint, [null, split], BEYOND).names
  assert name.clear > 3.0 and not name.certain
  inert = _scored(("a",), np.repeat([4.0, 4.0, 0.0], 10) + noise)
  assert naming.conclude(_Joint, [null, inert], BEYOND).named == ("a",)


def test_constants_that_are_strained_do_not_hold_a_motion_against_a_name(monkeypatch):
  """One motion is 0.8 nats a block worse; the other hypothesis' priors cost 2 nats a block."""
  null, split = _scored((), np.zeros(30)), _scored(("a",), np.repeat([4.0, 4.0, -0.8], 10))
  assert not naming.carries_over(_Joint, split, null)
  priors = {id(null): 60.0, id(split): 0.0}
  monkeypatch.setattr(Scored, "prior", property(lambda item: priors[id(item)]))
  assert naming.carries_over(_Joint, split, null)


def test_a_twin_with_more_beside_it_is_no_rival():
  null = _scored((), np.linspace(-4, -3, 30))
  right, twin = _scored(("a",), np.linspace(0, 0.1, 30)), _scored(("b",), np.linspace(0, 0.09, 30))
  more = _scored(("b", "c"), np.linspace(0, 0.11, 30), prediction=10.0)
  other = _scored(("c", "d"), np.linspace(0, 0.11, 30), prediction=10.0)
  assert naming.conclude(_Joint, [null, right, twin, more], BEYOND).named == ("a",)
  assert naming.conclude(_Joint, [null, right, twin, more, other], BEYOND).named == ()
  alike = _scored(("b", "c"), np.linspace(0, 0.08, 30))
  (name,) = naming.conclude(_Joint, [null, right, twin, alike], BEYOND).names
  assert name.confounded == (twin,)


def test_what_else_predicts_the_same_is_said_of_claimed_names_by_the_fewest_effects():
  few, more, other = (_scored(kinds, [0.0] * 30) for kinds in (("c",), ("c", "d"), ("a", "e")))
  names = [
    naming.Name("a", 9.0, True, (more, few)),
    naming.Name("b", 9.0, True, (other,)),  # certain, and in the reference, too
  ]
  said = Changed.confounded.fget(SimpleNamespace(found=SimpleNamespace(names=names), named=("a",)))
  assert said == [few]


@pytest.mark.parametrize(
  ("behind", "said"), [(2.0, "coulomb_friction"), (3.5, "asymmetric_friction")]
)
def test_a_special_case_is_said_where_the_general_kind_is_not_clear_of_it(
  monkeypatch, behind, said
):
  general, case, other = (
    SimpleNamespace(names=frozenset([kind]), neutral=False, beside_force=False)
    for kind in ("asymmetric_friction", "coulomb_friction", "viscous_friction")
  )
  monkeypatch.setattr(naming, "_same", lambda *_: True)
  monkeypatch.setattr(naming, "clear", lambda *_: behind)
  best = naming._usual(_Joint, general, [general, other, case], 3.0)
  assert best.names == {said}


def test_a_special_case_is_certain_where_all_have_it_in_either_form():
  """Friction that differs by direction is ahead, and a tilt beside plain friction does as well."""
  random = np.random.default_rng(0)
  noise = random.normal(0, 0.1, 30)
  null = _scored((), noise - 3.0)
  general = _scored(("asymmetric_friction",), noise)
  plain = _scored(("coulomb_friction",), noise - 0.3 + random.normal(0, 0.1, 30), prediction=7.0)
  tilted = _scored(("coulomb_friction", "gravity_tilt"), noise - 0.01, prediction=9.0)
  other = _scored(("viscous_friction",), noise - 2.0 + random.normal(0, 0.1, 30), prediction=3.0)
  ranked = [null, general, plain, tilted, other]
  found = naming.conclude(_Joint, ranked, BEYOND)
  assert found.named == ("coulomb_friction",) and found.best is plain
  clear_of_all = naming.conclude(_Joint, [null, general, plain, other], BEYOND)
  assert clear_of_all.named == ("asymmetric_friction",)
  as_good = _scored(("spring",), noise - 0.01, prediction=11.0)
  assert naming.conclude(_Joint, [*ranked, as_good], BEYOND).named == ()


@pytest.mark.parametrize(("behind", "said"), [(0.0, "encoder_offset"), (1.7, "payload")])
def test_of_hypotheses_that_predict_the_same_the_most_usual_is_said(monkeypatch, behind, said):
  load, shift, spring = (
    SimpleNamespace(names=frozenset([kind]), neutral=False, beside_force=False)
    for kind in ("payload", "encoder_offset", "spring")
  )
  monkeypatch.setattr(naming, "_same", lambda *_: True)
  monkeypatch.setattr(naming, "clear", lambda *_: behind)  # of the load, by which others are
  best = naming._usual(_Joint, load, [load, spring, shift], 3.0)
  assert best.names == {said}
  monkeypatch.setattr(naming, "clear", lambda *_: 0.0)
  assert naming._usual(_Joint, spring, [load, spring], 3.0) is load


def test_the_threshold_grows_with_what_was_tried():
  assert naming.thresholds(1)[0] == pytest.approx(1.645, abs=1e-3)  # 5 %
  assert naming.thresholds(20, 20)[0] > naming.thresholds(20)[0] > 2.8
  of_sets = [norm.isf(SETTINGS.level / n) for n in (20, 190, 1140)]
  assert naming.thresholds(20) == pytest.approx(of_sets)
