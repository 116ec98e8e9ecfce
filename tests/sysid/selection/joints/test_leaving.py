"""What a machine leaves anyway: noise of its readings, and what its constants differ by."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.joints import leaving, subject
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.joints.test_changes import few
from tests.sysid.synthetic import ARM, logs_of

STEADY = dataclasses.replace(
  SETTINGS,
  repeat=tuple((n, 0.0 if n in SETTINGS.wandering else s) for n, s in SETTINGS.repeat),
)


def _elbow(settings):
  model, logs = mujoco.MjModel.from_xml_string(ARM), logs_of(ARM, duration=4.0)
  return subject.prepare("elbow", Machine(model, logs), None, tried=2, settings=settings)


def test_friction_that_differs_within_a_recording_is_left_anyway(monkeypatch):
  monkeypatch.setattr(subject, "own_library", few)
  steady, wandering = _elbow(STEADY), _elbow(SETTINGS)
  noise = steady.now.noise_squares
  null = steady.explainer.null
  anyway, left = leaving.remaining(steady, null, healthy=True)
  assert anyway == pytest.approx([np.median(noise), noise.mean()])
  assert left[0] == pytest.approx(np.median(null.fit.held[0][0]))
  more, _ = leaving.remaining(wandering, wandering.explainer.null, healthy=True)
  assert np.all(more > 1.02 * anyway)
  # Between the two limits lies what one machine leaves and the other does not.
  between = SETTINGS.more**2 * 0.5 * (anyway[0] + more[0])
  item = SimpleNamespace(fit=SimpleNamespace(held=[np.full((1, len(noise)), between)]))
  assert leaving.is_unusual(steady, item, STEADY)
  assert not leaving.is_unusual(wandering, item, SETTINGS)
  for one, settings in ((steady, STEADY), (wandering, SETTINGS)):  # effects are tried all the same
    assert leaving.leaves(one, item, settings)
