"""The closed loop: motions, the gate before the recorder, and the whole loop (slow)."""

import json
import sys

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import read_log
from nerf2real.evaluation.loop.joint_space import closing, gap
from nerf2real.evaluation.loop.robot import motions, recording
from nerf2real.evaluation.loop.settings import LoopSettings
from nerf2real.launch import close_loop as script
from nerf2real.real.virtual import motors
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.suite.effects import Effect, read_effects, write_effects
from nerf2real.suite.op3 import constants
from nerf2real.sysid.data.compatibility import check_against_model


@pytest.mark.parametrize("kind", ["sweep", "slow", "steps", "mixed", "sway"])
def test_motions_begin_standing_and_stay_within_the_limits(kind):
  lower, upper = constants.joint_limits()
  targets = (lower + upper) / 2 + (upper - lower) / 2 * motions.motion(kind, 480)
  assert targets.shape == (480, 20)
  assert np.all(targets >= lower - 1e-6) and np.all(targets <= upper + 1e-6)
  np.testing.assert_allclose(targets[0], constants.standing_targets(), atol=1e-6)
  assert np.ptp(targets[80:], axis=0).min() > (0.009 if kind == "sway" else 0.1)  # all joints move


def test_motions_differ_between_fitting_and_judging():
  assert np.abs(motions.motion("mixed", 200) - motions.motion("sweep", 200)).max() > 0.1


def test_the_declared_model_hangs_by_its_torso():
  model = mujoco.MjModel.from_xml_string(motions.declared_model())
  assert {model.joint(i).name for i in range(model.njnt)} == set(constants.JOINT_NAMES)
  assert model.nu == 20 and model.nv == 20


def test_a_gate_notes_only_what_comes_while_it_is_open():
  class Notes:
    def __init__(self):
      self.seen = []

    def command(self, t, names, positions):
      self.seen.append(t)

  notes = Notes()
  gate = recording.Gate(notes)
  for t in range(6):
    gate.open = 2 <= t < 4
    gate.command(t, (), ())
  assert notes.seen == [2, 3]


def test_a_log_appears_whole_and_is_kept(tmp_path):
  path = tmp_path / "slow.mcap"

  def stop(gate):
    raise RuntimeError("the robot fell")

  with pytest.raises(RuntimeError, match="fell"):
    recording.record(path, stop)
  assert not path.exists()
  recording.record(path, lambda gate: None)
  whole = path.read_bytes()
  recording.record(path, stop)  # not played again
  assert whole and path.read_bytes() == whole


def test_effects_change_how_the_suite_moves(tmp_path):
  effects = [
    Effect("parameter_error", "l_knee", {"damping": 1.1, "gain": 0.95}),
    Effect("load_friction", "l_knee", {"coefficient": 0.3, "carried": 1.0}),
    Effect("payload", "r_knee_link", {"mass": 0.2, "x": 0.0, "y": 0.0, "z": -0.05}),
    Effect("command_delay", None, {"delay": 0.01}),
  ]
  write_effects(tmp_path / "effects.json", effects)
  actions = motions.motion("sway", 40)
  nominal = gap.suite_motion(None, actions)
  changed = gap.suite_motion(tmp_path / "effects.json", actions)
  assert nominal.shape == changed.shape == (40, 20)
  knee = constants.JOINT_NAMES.index("l_knee")
  assert 1e-4 < np.abs(changed - nominal)[:, knee].max() < 0.2


def test_strength_holds_the_gain_of_the_servos_law_once(tmp_path):
  """Constants hold the law's gain; a weak motor is named beside them."""
  by_duty = {"kind": "motor_gain", "evidence": {"servo_law": True}}
  by_duty |= {"parameters": {"gain": {"value": 0.9}}}
  weak = {"kind": "motor_gain", "joint": "r_knee", "evidence": {}}
  weak |= {"parameters": {"gain": {"value": 0.5}}}
  rows = [{**by_duty, "joint": joint} for joint in ("l_knee", "r_knee")]
  held = {joint: {"gain": 1.0} for joint in constants.JOINT_NAMES}
  del held["head_pan"]  # constants that the whole machine refuted
  held |= {joint: {"gain": 0.9 * 1.2} for joint in ("l_knee", "r_knee")}
  (tmp_path / "details.json").write_text(json.dumps({"calibration": held}))
  for effects in ([*rows, weak], [weak, *rows]):
    table = gap.hidden_table(1, {"effects": effects}, tmp_path / "details.json")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    found = {row[0]: row[4] for row in cells if row and row[0] in constants.JOINT_NAMES}
    assert found["l_knee"] == "1.08"
    assert found["r_knee"] == "0.54"
    assert found["head_pan"] == "1.00"


def test_hidden_zeros_take_the_place_of_those_found_as_the_robot_reads_them():
  others = [Effect("command_delay", None, {"delay": 0.01})]
  found = [*others, Effect("encoder_offset", "l_knee", {"offset": 0.5})]
  effects = gap.with_hidden_zeros(3, found)
  assert effects[:1] == others and len(effects) == 21
  servos = motors.Motors(Hidden.draw(3).motors)
  servos.measure(np.zeros(20), np.zeros(20))
  shown = 2 * np.pi / motors.COUNTS * (servos.counts - motors.CENTER)
  offsets = [e.parameters["offset"] for e in effects[1:]]
  np.testing.assert_allclose(shown, offsets, atol=np.pi / motors.COUNTS)


def test_an_unreachable_robot_is_one_line(monkeypatch, capsys, tmp_path):
  monkeypatch.setattr(
    sys, "argv", ["close_loop.py", "--robot", str(tmp_path / "tty"), "--out", str(tmp_path / "o")]
  )
  assert script.main() != 0
  error = capsys.readouterr().err
  assert error.startswith("error: ") and error.count("\n") == 1


@pytest.mark.slow
def test_the_loop_closes_on_the_virtual_robot(tmp_path):
  content = closing.close_loop(LoopSettings(out=tmp_path, seed=1, seconds=6.0)).content
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "identified/declared.xml"))
  for name in ("sweep", "slow", "steps", "mixed"):
    log = read_log(tmp_path / f"{name}.mcap")
    check_against_model(log, model)
    assert log.duration == pytest.approx(6.0, abs=0.2)
    assert np.abs(log.states.position[5] - log.states.position[0]).max() < 0.01  # from rest
  assert content["verdict"] != "none"  # the virtual servos are other ones
  assert "load_friction" in {e["kind"] for e in [*content["effects"], *content["alternatives"]]}
  assert content["error"]["train"]["after"] < content["error"]["train"]["before"]
  assert json.loads((tmp_path / "identified/finding.json").read_text()) == content
  assert read_effects(tmp_path / "identified/effects.json")
  table = (tmp_path / "gap.md").read_text()
  assert all(f"| {name} |" in table for name in constants.JOINT_NAMES)
