"""Loads that one joint shows, as those that carry it feel them."""

from types import SimpleNamespace

import mujoco
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.joints import changes, subject
from nerf2real.sysid.selection.wider import loads
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.wider.test_zeros import CHAIN
from tests.sysid.synthetic import log_of

VALUES = {"mass": 0.1, "x": 0.0, "y": 0.0, "z": -0.2}
LOAD = Effect("payload", "lower", VALUES)


@pytest.fixture
def machine(monkeypatch):
  """Returns the model, the shoulder as it is explained where nothing is tried, and the elbow."""
  monkeypatch.setattr(subject, "own_library", lambda plant, **_: [])
  model = mujoco.MjModel.from_xml_string(CHAIN)

  def explained(effects):
    logs = [log_of(CHAIN, kind, effects, duration=5.0) for kind in ("sweep", "slow")]
    shoulder, elbow = (
      subject.prepare(joint, Machine(model, logs), None, tried=2, settings=SETTINGS)
      for joint in ("shoulder", "elbow")
    )
    return model, changes.explain(shoulder), elbow

  return explained


def _elbow(subject, *, named):
  """Returns an explanation of the elbow by a load, or one to which a load is the likeliest."""
  term = next(t for t in candidates.library(subject.now.plant) if t.kind == loads.LOAD)
  fit = SimpleNamespace(values=lambda of: {term: VALUES}[of])
  by_load = SimpleNamespace(terms=(term,), names={loads.LOAD}, fit=fit, evidence=0.0, neutral=False)
  plain = subject.explainer.null
  best = by_load if named else plain
  subject.explainer.library = [term, *subject.explainer.library]
  subject.explainer.scored[(term,)] = by_load
  return SimpleNamespace(
    joint="elbow",
    subject=subject,
    likelihood=subject.now,
    ranked=[by_load, plain],
    found=SimpleNamespace(best=best),
    extended=best,
  )


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("effects", [[LOAD], []])
def test_a_load_of_one_joint_is_one_where_those_that_carry_it_feel_it(machine, effects, named):
  model, shoulder, subject = machine(effects)
  elbow = _elbow(subject, named=named)
  kept, again = loads.borne(model, [shoulder, elbow], SETTINGS)
  assert kept is shoulder
  assert (again is elbow) is bool(effects)
  if not effects:
    assert again.verdict == "none"
    assert not any(loads.LOAD in s.names for s in again.ranked)
    assert not any(t.kind == loads.LOAD for t in subject.explainer.library)


def test_a_load_that_nothing_carries_is_its_joint_s(machine):
  model, shoulder, subject = machine([])
  elbow = _elbow(subject, named=True)
  assert loads.borne(model, [elbow], SETTINGS) == [elbow]
  assert loads.borne(model, [shoulder], SETTINGS) == [shoulder]
