"""What the whole machine's error says of effects that were found joint by joint."""

from types import SimpleNamespace

import mujoco
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.whole_machine import discard_refuted
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import ARM, log_of

_TRUE = Effect("coulomb_friction", "shoulder", {"torque": 0.2})
_WRONG = Effect("viscous_friction", "elbow", {"coefficient": 0.6})


def _row(effect: Effect, clear: float) -> dict:
  evidence = {"clear_by_standard_errors": clear}
  return {"kind": effect.kind, "joint": effect.target, "parameters": {}, "evidence": evidence}


def _found(*, follows: bool = False) -> Identified:
  joints = [
    SimpleNamespace(
      joint=name,
      verdict="effects",
      elaborated=["a fit"],
      likelihood=SimpleNamespace(follows=follows),
    )
    for name in ("shoulder", "elbow")
  ]
  model, log = mujoco.MjModel.from_xml_string(ARM), log_of(ARM, "sweep", [_TRUE], duration=4.0)
  found = Identified(model, [log], joints, [], "effects")  # type: ignore[arg-type]
  found.objects += [_TRUE, _WRONG]
  found.effects += [_row(_TRUE, 8.0), _row(_WRONG, 9.0)]
  return found


def test_an_effect_that_makes_the_whole_machine_worse_is_taken_out() -> None:
  found = _found()
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE]
  assert [row["kind"] for row in found.effects] == ["coulomb_friction"]
  assert [row["kind"] for row in found.nearest] == ["viscous_friction"]
  assert [(j.verdict, j.elaborated) for j in found.joints] == [
    ("effects", ["a fit"]),
    ("unexplained", []),
  ]


def test_the_joint_that_a_refuted_payload_was_claimed_of_is_unexplained() -> None:
  found = _found()
  payload = Effect("payload", "lower", {"mass": 0.5, "x": 0.0, "y": 0.0, "z": -0.2})
  found.objects[:] = [_TRUE, payload]
  found.effects[1:] = [_row(payload, 9.0) | {"joint": "elbow", "body": "lower"}]
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE]
  assert [(j.verdict, j.elaborated) for j in found.joints] == [
    ("effects", ["a fit"]),
    ("unexplained", []),
  ]


def test_what_is_not_claimed_of_a_joint_is_taken_out_together() -> None:
  found = _found()
  other = Effect("encoder_offset", "elbow", {"offset": 0.0})
  found.effects, found.objects = found.effects[:1], [_TRUE, other, _WRONG]
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE]
  assert [j.verdict for j in found.joints] == ["effects", "effects"]


def test_windows_refute_what_is_not_claimed_where_courses_do_not_repeat() -> None:
  found = _found(follows=True)
  found.effects = found.effects[:1]
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE]
  assert [j.verdict for j in found.joints] == ["effects", "effects"]


def test_courses_that_do_not_repeat_refute_no_claim() -> None:
  found = _found(follows=True)
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE, _WRONG] and len(found.effects) == 2


@pytest.mark.parametrize("worse", [True, False])
def test_one_joint_claims_nothing_where_it_leaves_more_than_the_declared_model(worse: bool) -> None:
  found = _found()
  found.joints = [j for j in found.joints if j.joint == (_WRONG if worse else _TRUE).target]
  found.objects = [_WRONG if worse else _TRUE]
  found.effects = [row for row in found.effects if row["joint"] == found.joints[0].joint]
  discard_refuted(found, SETTINGS)
  assert bool(found.objects) is bool(found.effects) is not worse
  assert [j.verdict for j in found.joints] == ["unexplained" if worse else "effects"]
