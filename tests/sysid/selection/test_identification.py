"""The whole tool: verdicts, files, bad input."""

import dataclasses
import itertools
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real import sysid
from nerf2real.core.robot_logs.reading import LogError
from nerf2real.suite.effects import Effect, EffectStack, read_effects
from nerf2real.suite.effects.files import from_list
from nerf2real.sysid.data.audit import audit
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.outputs import extended_model
from nerf2real.sysid.selection import analysis
from nerf2real.sysid.selection.analysis import analyse
from tests.sysid.synthetic import ARM, PENDULUM, log_of, logs_of

SAMPLES = Path(__file__).parents[3] / "../shared/data/sysid_samples"


def test_healthy_machine_is_not_accused() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  found = analyse(model, logs_of(PENDULUM))
  assert found.verdict == "none"
  assert found.effects == []


def test_a_models_long_step_is_no_fault_of_the_machine() -> None:
  machine = PENDULUM.replace('damping="1.0"', 'damping="2.5"').replace("-4 4", "-12 12")
  machine = machine.replace('kp="21"', 'kp="60"').replace('timestep="0.001"', 'timestep="0.0005"')
  kinds = ("sweep", "slow", "steps")
  logs = [log_of(machine, kind, rounding=2e-5, seed=i) for i, kind in enumerate(kinds)]
  model = mujoco.MjModel.from_xml_string(machine)
  model.opt.timestep = 0.004
  found = analyse(model, logs)
  assert (found.verdict, found.effects) == ("none", [])
  (joint,) = found.joints
  constants = joint.found.best.terms[0]
  assert joint.found.best.fit.values(constants)["armature"] < -0.06


def test_delay_is_named_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  logs = logs_of(PENDULUM, [Effect("command_delay", "joint", {"delay": 0.04})])
  held = log_of(PENDULUM, "sweep", [Effect("command_delay", "joint", {"delay": 0.04})], seed=9)
  (tmp_path / "model.xml").write_text(PENDULUM)
  files = {f"{i}.mcap": log for i, log in enumerate([*logs, held])}
  monkeypatch.setattr("nerf2real.sysid.data.opening.read_log", lambda path: files[Path(path).name])
  content = sysid.identify(
    tmp_path / "model.xml",
    [Path(f"{i}.mcap") for i in range(3)],
    held=[Path("3.mcap")],
    out=tmp_path / "out",
  )
  assert content["verdict"] == "effects"
  (effect,) = content["effects"]
  assert (effect["kind"], effect["joint"]) == ("command_delay", "joint")
  assert effect["parameters"]["delay"]["value"] == pytest.approx(0.04, abs=1e-3)
  error = content["error"]["held"]
  assert error["after"] < 0.05 * error["before"]
  assert json.loads((tmp_path / "out/report.json").read_text()) == content
  effects = read_effects(tmp_path / "out/effects.json")
  EffectStack(effects).bind(mujoco.MjModel.from_xml_path(str(tmp_path / "out/model_extended.xml")))
  page = (tmp_path / "out/report.html").read_text()
  for title in ("Verdict", "Evidence", "Logs that were not fitted"):
    assert title in page
  (row,) = sysid.evaluate(tmp_path / "out", [Path("3.mcap")])
  assert row["after"] == pytest.approx(error["after"], rel=1e-3)


def test_extended_model_has_the_error_that_is_reported(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  effects = [Effect("coulomb_friction", "joint", {"torque": 0.25})]
  logs = logs_of(PENDULUM, effects)
  held = log_of(PENDULUM, "sweep", effects, seed=9)
  (tmp_path / "model.xml").write_text(PENDULUM)
  files = {f"{i}.mcap": log for i, log in enumerate([*logs, held])}
  monkeypatch.setattr("nerf2real.sysid.data.opening.read_log", lambda path: files[Path(path).name])
  names = [Path(f"{i}.mcap") for i in range(3)]
  content = sysid.identify(
    tmp_path / "model.xml", names, held=[Path("3.mcap")], out=tmp_path / "out"
  )
  assert content["effects"][0]["kind"] == "coulomb_friction"
  extended = mujoco.MjModel.from_xml_path(str(tmp_path / "out/model_extended.xml"))
  details = json.loads((tmp_path / "out/details.json").read_text())
  clocks = {joint: evaluation.Clocks(**values) for joint, values in details["clocks"].items()}
  # MJCF holds a servo that reads its joint's place wrongly, not the reading that a log keeps.
  whole = from_list(details["extended"])
  offset = sum(e.parameters["offset"] for e in whole if e.kind == "encoder_offset")
  read = evaluation.simulate(extended, held, clocks=clocks) + offset
  got = float(np.sqrt(np.mean((read - held.states.position) ** 2)))
  assert got == pytest.approx(content["error"]["held"]["after"], rel=0.01)
  # What others read; the rest is in details.json.
  assert set(content) == {
    "verdict",
    "effects",
    "in_reference",
    "alternatives",
    "residual_at",
    "error",
    "window_s",
    "seconds",
    "notes",
    "next_excitation",
  }
  assert set(content["error"]) == {"train", "held", "floor"}
  # The constants that were fitted beside the effect go with it.
  kinds = {e.kind for e in read_effects(tmp_path / "out/effects.json")}
  assert kinds == {"coulomb_friction", "parameter_error", "encoder_offset"}


def test_extended_model_finds_its_meshes_from_any_folder(tmp_path: Path) -> None:
  (tmp_path / "meshes").mkdir()
  corners = ["0 0 0", ".1 0 0", "0 .1 0", "0 0 .1"]
  faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
  text = "".join(f"v {c}\n" for c in corners) + "".join(f"f {f}\n" for f in faces)
  (tmp_path / "meshes" / "part.obj").write_text(text)
  model = PENDULUM.replace("<worldbody>", '<asset><mesh file="part.obj"/></asset><worldbody>')
  model = model.replace("<option", '<compiler meshdir="meshes"/><option')
  model = model.replace("</body></worldbody>", '<geom type="mesh" mesh="part"/></body></worldbody>')
  (tmp_path / "model.xml").write_text(model)
  (tmp_path / "out").mkdir()
  extended_model.write(tmp_path / "model.xml", tmp_path / "out" / "extended.xml", [])
  assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "extended.xml")).nmesh == 1


def test_a_joint_that_holds_still_is_looked_at_without_harm() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "slow", duration=3.0)
  still = dataclasses.replace(log.states, position=np.full_like(log.states.position, 0.3))
  plant = JointModel(model, "joint", [dataclasses.replace(log, states=still)])
  waves = signatures.waves(plant)
  assert all(np.isfinite(waves).ravel())


def test_wrong_constants_come_out_as_parameter_error() -> None:
  truth = {"damping": 1.12, "armature": 0.88}
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  found = analyse(model, logs_of(PENDULUM, [Effect("parameter_error", "joint", truth)]))
  assert [e["kind"] for e in found.effects] == ["parameter_error"]
  values = found.effects[0]["parameters"]
  for name, factor in truth.items():
    assert values[name]["value"] == pytest.approx(factor, abs=0.03)


def test_reference_logs_take_wrong_constants_out() -> None:
  off = Effect("parameter_error", "joint", {"damping": 1.15, "armature": 0.85})
  delay = Effect("command_delay", "joint", {"delay": 0.03})
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = logs_of(PENDULUM, [off, delay])
  found = analyse(model, logs, reference=logs_of(PENDULUM, [off]))
  assert found.effects[0]["kind"] == "command_delay"
  assert found.effects[0]["parameters"]["delay"]["value"] == pytest.approx(0.03, abs=1e-3)


def test_payload_is_put_on_the_body_that_carries_it() -> None:
  payload = Effect("payload", "lower", {"mass": 0.25, "x": 0.0, "y": 0.02, "z": -0.12})
  model = mujoco.MjModel.from_xml_string(ARM)
  found = analyse(model, logs_of(ARM, [payload]))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("payload", "elbow")]
  assert found.effects[0]["parameters"]["mass"]["value"] == pytest.approx(0.25, rel=0.25)


def test_what_has_no_name_is_a_force_of_any_form() -> None:
  weights = np.zeros((5, 5))
  weights[3:, :] = -0.6  # a soft stop: a push back beyond half the range
  table = Effect(
    "residual_force",
    "joint",
    {"weights": [float(w) for w in weights.ravel()], "position_low": -1.0, "position_high": 1.0},
  )
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = logs_of(PENDULUM, [table])
  found = analyse(model, logs)
  assert found.verdict in ("partly", "unexplained")  # a spring is its better half
  assert "residual_force" not in {row["kind"] for row in found.effects}
  assert "residual_force" in {e.kind for e in found.objects}
  effects = [*found.calibration, *found.objects]
  after = evaluation.error(model, logs, effects, clocks=found.clocks)
  assert after < 0.4 * evaluation.error(model, logs)


@pytest.mark.parametrize(
  "effect",
  [
    Effect("parameter_error", "joint", {"damping": 1.1, "armature": 0.9, "gain": 1.1}),
    Effect("coulomb_friction", "joint", {"torque": 0.2}),
    Effect("viscous_friction", "joint", {"coefficient": 0.3}),
    Effect("quadratic_drag", "joint", {"coefficient": 0.2}),
    Effect("motor_gain", "joint", {"gain": 0.8}),
    Effect("torque_limit", "joint", {"limit": 1.5}),
    Effect("encoder_offset", "joint", {"offset": 0.05}),
    Effect("spring", "joint", {"stiffness": 0.8, "reference": 0.2}),
    Effect("payload", "arm", {"mass": 0.1, "x": 0.01, "y": 0.0, "z": -0.1}),
    Effect("gravity_tilt", None, {"x": 0.02, "y": 0.1}),
  ],
  ids=lambda e: e.kind,
)
def test_extended_model_moves_as_the_effect_does(effect: Effect, tmp_path: Path) -> None:
  (tmp_path / "model.xml").write_text(PENDULUM)
  left = extended_model.write(tmp_path / "model.xml", tmp_path / "extended.xml", [effect])
  assert left == []
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  extended = mujoco.MjModel.from_xml_path(str(tmp_path / "extended.xml"))
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=2.0)
  want = evaluation.simulate(model, log, [effect])
  got = evaluation.simulate(extended, log)
  if effect.kind == "encoder_offset":  # the reading is not in the model, the servo's loop is
    want = want - effect.parameters["offset"]
    want, got = want[100:], got[100:]  # they start an offset apart
  assert np.abs(want - evaluation.simulate(model, log)[-len(want) :]).max() > 1e-3
  np.testing.assert_allclose(got, want, atol=2e-3 if effect.kind == "encoder_offset" else 1e-6)


def test_extended_model_leaves_what_mjcf_cannot_say(tmp_path: Path) -> None:
  (tmp_path / "model.xml").write_text(PENDULUM)
  load = Effect("load_friction", "joint", {"coefficient": 0.2})
  assert extended_model.write(tmp_path / "model.xml", tmp_path / "e.xml", [load]) == [load]


def test_audit_reports_gaps_and_rates() -> None:
  log = log_of(PENDULUM, "slow", duration=3.0)
  found = audit(log)
  assert found["state_rate_hz"] == pytest.approx(100.0)
  assert found["command_rate_hz"] == pytest.approx(50.0)
  assert found["state_gaps"] == 0
  assert found["warnings"] == []
  stamp = log.states.stamp.copy()
  stamp[100:] += 0.2
  log.states.stamp[:] = stamp
  assert audit(log)["state_gaps"] == 1


def test_audit_is_of_stamps_that_differ() -> None:
  log = log_of(PENDULUM, "slow", duration=3.0)
  log.states.stamp[1::2] = log.states.stamp[: len(log.states.stamp) // 2 * 2 : 2]
  found = audit(log)
  assert found["duplicate_stamps"] == len(log.states.stamp) // 2
  assert found["state_rate_hz"] == pytest.approx(50.0) and found["state_gaps"] == 0


def test_a_still_joint_does_not_hide_the_readings_steps() -> None:
  log = log_of(ARM, "slow", duration=3.0)
  step = audit(log)["position_step"]
  log.states.position[:, 1] = 0.3
  assert audit(log)["position_step"] == pytest.approx(step, rel=1e-6) and step > 0.0


def test_bad_input_is_one_clear_error(tmp_path: Path) -> None:
  with pytest.raises(FileNotFoundError, match=r"no file .*model\.xml"):
    sysid.identify(tmp_path / "model.xml", [tmp_path / "a.mcap"], out=tmp_path / "out")
  (tmp_path / "model.xml").write_text("<mujoco><nonsense/></mujoco>")
  with pytest.raises(ValueError, match="not a MuJoCo model"):
    sysid.identify(tmp_path / "model.xml", [tmp_path / "a.mcap"], out=tmp_path / "out")
  (tmp_path / "model.xml").write_text(PENDULUM)
  with pytest.raises(ValueError, match="no log to identify from"):
    sysid.identify(tmp_path / "model.xml", [], out=tmp_path / "out")
  with pytest.raises(FileNotFoundError, match=r"a\.mcap"):
    sysid.identify(tmp_path / "model.xml", [tmp_path / "a.mcap"], out=tmp_path / "out")
  (tmp_path / "a.mcap").write_bytes(b"not an mcap")
  with pytest.raises(LogError, match="not an MCAP"):
    sysid.identify(tmp_path / "model.xml", [tmp_path / "a.mcap"], out=tmp_path / "out")
  with pytest.raises(FileNotFoundError, match=r"report\.json"):
    sysid.evaluate(tmp_path, [tmp_path / "a.mcap"])


@pytest.mark.slow
@pytest.mark.skipif(not SAMPLES.exists(), reason="needs ../shared/data/sysid_samples")
@pytest.mark.parametrize("name", ["s1_null", "s2_delay", "s3_viscous", "s4_payload"])
def test_sample_sets_with_known_answers(name: str, tmp_path: Path) -> None:
  folder = SAMPLES / name
  truth = json.loads((SAMPLES / "answers.json").read_text())[name]["effects"]
  content = sysid.identify(
    folder / "model.xml",
    sorted(folder.glob("train*")),
    held=sorted(folder.glob("held*")),
    out=tmp_path,
  )
  named = [(e["kind"], e["joint"]) for e in content["effects"]]
  assert named == [(e["kind"], e["joint"]) for e in truth]
  error = content["error"]["held"]
  if truth:
    assert error["after"] < 0.4 * error["before"]
  assert error["after"] < 1.3 * content["error"]["floor"]


def test_a_verdict_speaks_of_effects_only_where_one_is_claimed() -> None:
  grades = ("none", "effects", "partly", "unexplained")
  for joints in itertools.combinations_with_replacement(grades, 3):
    said = {claimed: analysis.machine_verdict(joints, claimed=claimed) for claimed in (False, True)}
    assert said[False] in ("none", "unexplained")
    assert said[True] in ("effects", "partly")
    left = bool({"partly", "unexplained"} & set(joints))
    assert (said[True] == "partly") == left
    assert (said[False] == "none") == (set(joints) == {"none"})
