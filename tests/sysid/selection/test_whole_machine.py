"""What the whole machine's error says of effects that were found joint by joint."""

import dataclasses
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


@pytest.mark.parametrize("joints", [["shoulder"], ["elbow"], ["shoulder", "elbow"]])
def test_nothing_is_claimed_where_it_leaves_more_than_the_declared_model(joints) -> None:
  found = _found()
  found.joints = [j for j in found.joints if j.joint in joints]
  found.objects = [e for e in found.objects if e.target in joints]
  found.effects = [row for row in found.effects if row["joint"] in joints]
  claimed = list(found.effects)
  discard_refuted(found, SETTINGS)
  worse = "elbow" in joints
  assert bool(found.objects) is bool(found.effects) is not worse
  assert found.nearest == (claimed if worse else [])
  after = ("unexplained", []) if worse else ("effects", ["a fit"])
  assert [(j.verdict, j.elaborated) for j in found.joints] == [after] * len(joints)


def test_no_joint_keeps_an_effect_of_the_whole_machine_that_is_refuted() -> None:
  found = _found()
  found.objects[:] = [dataclasses.replace(_WRONG, target=name) for name in ("shoulder", "elbow")]
  found.effects[:] = [_row(_WRONG, 9.0) | {"joint": None}]
  discard_refuted(found, SETTINGS)
  assert not found.effects and {j.verdict for j in found.joints} == {"unexplained"}


def test_courses_that_do_not_repeat_refute_no_claim() -> None:
  found = _found(follows=True)
  discard_refuted(found, SETTINGS)
  assert found.objects == [_TRUE, _WRONG] and len(found.effects) == 2
