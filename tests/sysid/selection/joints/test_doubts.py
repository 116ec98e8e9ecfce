"""Whether a name that is clear stands."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses.constants import own_size
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.joints import doubts
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of


@pytest.mark.parametrize(
  "name, value, half, off",
  [
    ("friction", 0.33, 0.13, False),  # a healthy copy of a kind whose dry friction differs so
    ("friction", 0.9, 0.13, True),
    ("friction", 0.9, 0.6, False),
    ("damping", 0.12, 0.03, True),
    ("damping", 0.12, 0.07, False),
  ],
)
def test_a_constant_is_off_by_more_than_copies_differ_by(monkeypatch, name, value, half, off):
  tolerance = dict(SETTINGS.tolerances)
  prior = (tolerance[name], tolerance["zero"])
  term = SimpleNamespace(names=(name, "zero"), freed=False, prior=prior)
  values = {name: value, "zero": 0.5}
  best = SimpleNamespace(terms=[term], fit=SimpleNamespace(values=lambda term: values))
  bounds = {name: (value - half, value + half), "zero": (0.4, 0.6)}
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: bounds)
  judged = SimpleNamespace(before=None, now=None, beyond=3.2)
  assert doubts.constants_off(judged, best, SETTINGS) == off


@pytest.mark.parametrize(
  "mass, freed, stopped", [(-0.15, True, True), (-0.14, True, False), (-0.15, False, False)]
)
def test_constants_that_are_stopped_by_their_range_stand_in_for_something(mass, freed, stopped):
  names = ("mass", "latency")
  limits = {"low": (-0.15, 0.0), "high": (0.15, 0.01), "prior": (0.03, 0.002)}
  term = SimpleNamespace(names=names, freed=freed, **limits)
  values = {"mass": mass, "latency": 0.0}  # no latency is not the end of a range
  best = SimpleNamespace(terms=[term], fit=SimpleNamespace(values=lambda term: values))
  assert doubts.pressed(best) == stopped


def test_without_an_effect_all_else_stays_as_it_was_fitted_beside_it():
  known = SimpleNamespace(kind=CONSTANTS, name=None, names=("gain",), centre=(0.1,))
  freed = SimpleNamespace(kind=CONSTANTS, name="parameter_error", names=("gain",))
  friction = SimpleNamespace(kind="friction", name="friction", names=("torque",))
  values = {"parameter_error": {"gain": 0.4}, "friction": {"torque": 3.0}}
  item = SimpleNamespace(
    terms=(freed, friction), fit=SimpleNamespace(values=lambda term: values[term.name])
  )
  asked = []

  def residuals(terms, xs):
    asked.append((terms, xs.tolist()))
    return np.ones((1, 1, 6))

  joint = SimpleNamespace(residuals=residuals, squares=np.square, log_of=np.zeros(6))
  explainer = SimpleNamespace(joint=joint, base=(known,))
  assert doubts._left_bare(explainer, item, "friction") == 1.0
  assert doubts._left_bare(explainer, item, "parameter_error") == 1.0
  assert asked == [([freed], [[0.4]]), ([known, friction], [[0.1, 3.0]])]


def test_beside_a_reference_only_what_may_have_changed_is_stopped():
  """Dry friction of four times the declared one was the machine's before."""
  term = SimpleNamespace(
    names=("friction", "armature"),
    freed=True,
    low=(-0.9, -0.7),
    high=(4.0, 2.0),
    prior=(0.25, float("inf")),
  )
  for armature, stopped in ((1.5, False), (2.0, True)):
    values = {"friction": 4.0, "armature": armature}
    fit = SimpleNamespace(values=lambda _, values=values: values)
    assert doubts.pressed(SimpleNamespace(terms=[term], fit=fit)) == stopped


@pytest.mark.parametrize(
  "value, half, something",
  [
    (0.92, 0.02, False),  # less friction, as another recording of the machine may have it
    (0.6, 0.1, True),
    (0.6, 0.35, False),
  ],
)
def test_a_constant_that_changed_did_so_by_more_than_recordings_differ(
  monkeypatch, value, half, something
):
  names, repeat = ("friction", "gain"), (0.05, 0.005)
  known = SimpleNamespace(prior=repeat, centre=(0.0, 0.0))
  freed = SimpleNamespace(
    name="parameter_error", freed=True, names=names, prior=(float("inf"), 0.005)
  )
  # The gain, which is not free, is beyond what recordings differ by: the friction is judged.
  bounds = {"friction": (value - 1.0 - half, value - 1.0 + half), "gain": (0.1, 0.2)}
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: bounds)
  judged = SimpleNamespace(before=object(), now=SimpleNamespace(settings=SETTINGS), known=(known,))
  best = SimpleNamespace(terms=[freed], fit=None)
  assert doubts.is_something(judged, best, "parameter_error") == something


@pytest.mark.parametrize("reference", [None, object()])
@pytest.mark.parametrize(
  ("low", "hinge", "something"), [(0.0016, True, False), (0.006, True, True), (0.0016, False, True)]
)
def test_play_of_a_healthy_gear_is_nothing(monkeypatch, reference, low, hinge, something):
  term = SimpleNamespace(name="backlash", kind="backlash", names=("gap",), freed=False)
  bounds = {"gap": (low, low + 0.002)}  # rad, or m of a slide
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: bounds)
  now = SimpleNamespace(settings=SETTINGS, plant=SimpleNamespace(hinge=hinge))
  judged = SimpleNamespace(before=reference, now=now)
  best = SimpleNamespace(terms=[term], fit=None)
  assert doubts.is_something(judged, best, "backlash") == something
  term.name = None  # as of one that the reference has
  assert doubts.exceeds(judged, best, term) == something


@pytest.mark.parametrize(("skew", "something"), [(0.0003, True), (-0.0009, False)])
def test_a_delay_that_a_clock_takes_back_is_nothing(monkeypatch, skew, something):
  """Readings as late as before, for which a late reading and an early clock stand: their efforts
  alone come otherwise."""
  kind = "measurement_delay"
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: {"delay": (0.001, 0.0034)})
  term = SimpleNamespace(name=kind, kind=kind, names=("delay",), freed=False)
  own = SimpleNamespace(names=("skew", "latency"), centre=(0.0003, 0.001))
  values = {"skew": skew, "latency": 0.001}
  now = SimpleNamespace(settings=SETTINGS, plant=SimpleNamespace(hinge=True, holds=True))
  judged = SimpleNamespace(before=object(), now=now, known=(own,))
  best = SimpleNamespace(terms=[own, term], fit=SimpleNamespace(values=lambda _: values))
  assert doubts.exceeds(judged, best, term) == something


@pytest.mark.parametrize(
  ("reference", "low", "something"),
  [(None, 5.0, False), (None, 7.0, True), (object(), 1.0, False), (object(), 2.0, True)],
)
def test_damping_that_a_servos_own_is_off_by_is_nothing(monkeypatch, reference, low, something):
  bounds = {"coefficient": (low, low + 1.0)}  # N m s/rad, of a servo that is declared with 100
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: bounds)
  declared = np.zeros(len(INDEX))
  declared[INDEX["velocity"]] = -100.0
  now = SimpleNamespace(settings=SETTINGS, plant=SimpleNamespace(declared=declared, holds=True))
  kind = "viscous_friction"
  term = SimpleNamespace(name=kind, kind=kind, names=("coefficient",), freed=False)
  judged = SimpleNamespace(before=reference, now=now)
  best = SimpleNamespace(terms=[term], fit=None)
  assert doubts.is_something(judged, best, "viscous_friction") == something
  declared[:] = 0.0
  assert doubts.is_something(judged, best, "viscous_friction")


@pytest.mark.parametrize("without, new", [(-0.1, True), (-5.0, False)])
def test_what_constants_are_better_for_otherwise_says_nothing_of_an_effect(
  monkeypatch, without, new
):
  """Logs are a nat a block better at the constants of a reference that has the effect, too: what
  the reference says at the same constants counts, unless it is itself far better with the effect.
  """

  def scored(nats, *terms):
    fit = SimpleNamespace(values=lambda term: {"gain": 0.1} if term.names else {})
    return SimpleNamespace(
      nats=np.full(30, nats), prior=0.0, evidence=30 * nats, terms=terms, fit=fit
    )

  own = Term(CONSTANTS, "joint", ("gain",), (-1.0,), (1.0,), (0.1,), ((0.0,),), prior=(0.02,))
  effect = Term("stribeck_friction", "joint", (), (), (), (), ((),))
  judged = SimpleNamespace(before="before", now="now", known=(own,), usual=scored(0.0, own))
  given = iter([scored(-1.0, own), scored(-2.0, own), scored(without, own)])
  asked = []
  monkeypatch.setattr(
    doubts, "scored_on", lambda joint, *_, **__: asked.append(joint) or next(given)
  )
  gains, prior = doubts.newness(judged, scored(-3.1, own, effect), effect, effect)
  assert asked == ["before", "now", "before"]
  assert doubts.more_likely(gains, prior, 0.05) == new


@pytest.mark.parametrize(
  "low, reference, something",
  [
    (0.003, False, False),
    (0.019, False, False),
    (0.03, False, True),
    (0.003, True, True),  # the reference has what a healthy one loses
  ],
)
def test_what_a_healthy_mesh_of_gears_loses_is_no_effect(monkeypatch, low, reference, something):
  term = SimpleNamespace(
    name="load_friction", kind="load_friction", names=("coefficient",), freed=False
  )
  bounds = {"coefficient": (low, low + 0.01)}
  monkeypatch.setattr(doubts.intervals, "intervals", lambda *_, **__: bounds)
  plant = SimpleNamespace(hinge=True, holds=True)
  before = object() if reference else None
  joint = SimpleNamespace(before=before, now=SimpleNamespace(plant=plant, settings=SETTINGS))
  best = SimpleNamespace(terms=[term], fit=None)
  assert doubts.is_something(joint, best, "load_friction") == something


@pytest.mark.parametrize(
  ("low", "reference", "something"),
  [(0.005, False, False), (0.011, False, False), (0.013, False, True), (0.005, True, True)],
)
def test_what_a_declared_dry_friction_may_be_off_by_is_no_effect(low, reference, something) -> None:
  """0.03 N m with a tolerance of a fifth: 0.012 N m in 95 % of machines."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  plant = JointModel(model, "joint", [log_of(PENDULUM, "slow", duration=2.0)])
  own = own_size(plant, "coulomb_friction", "torque", repeated=reference)
  assert (low > own) == something
  assert own == own_size(plant, "asymmetric_friction", "negative", repeated=reference)


@pytest.mark.parametrize(
  ("mass", "arm", "together", "shows"),
  [
    (0.3, 0.1, -0.99, True),
    (0.3, 0.1, 0.0, False),
    (0.6, 0.1, -0.99, True),
    (0.6, 0.1, 0.0, False),
  ],
)
def test_a_load_is_something_where_a_moment_is_sure(monkeypatch, mass, arm, together, shows):
  """Its mass may be open: half of it at twice the arm weighs the same, a quarter turns the same."""
  term = SimpleNamespace(kind="payload", names=("mass", "x", "y", "z"))
  layout = SimpleNamespace(terms=[term], spans=[(1, 5)])
  fit = SimpleNamespace(layout=layout, x=np.array([9.0, 0.3, 0.1, 0.0, 0.0]))
  spread = np.diag([1.0, mass, arm, arm, arm])
  correlation = np.eye(5)
  correlation[1, 2] = correlation[2, 1] = together
  covariance = spread @ correlation @ spread
  monkeypatch.setattr(doubts.intervals, "spread", lambda *_: covariance)
  judged = SimpleNamespace(now=SimpleNamespace(settings=SETTINGS))
  assert doubts._moment_shows(judged, SimpleNamespace(fit=fit), term) == shows
  other = SimpleNamespace(kind="spring", names=("stiffness", "reference"))
  assert not doubts._moment_shows(judged, SimpleNamespace(fit=fit), other)
