"""`launch/identify.py`: bad input is one line that says what was found and what to do."""

import sys

import numpy as np
import pytest

from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log
from nerf2real.launch import identify as script
from tests.sysid.synthetic import ARM, PENDULUM

START = 1_700_000_000_000_000_000
NO_ACTUATOR = PENDULUM.replace(
  '<position name="joint" joint="joint" kp="21" forcerange="-4 4"/>', ""
)


@pytest.fixture
def identify(monkeypatch, capsys):
  """Runs the command line; returns exit code, stdout and stderr."""

  def run(*arguments):
    monkeypatch.setattr(sys, "argv", ["identify.py", *map(str, arguments)])
    code = script.main()
    return code, *capsys.readouterr()

  return run


def _log(path, *, duration=3.0, commands=True, joints=("joint",), spoil=None, cut=None):
  """Writes a log of joints that move; `spoil(index, fields)` changes states."""
  with open_log(path) as log:
    for index in range(round(duration * 100)):
      t = START + index * 10_000_000
      if commands and index % 2 == 0:
        log.write(messages.joint_state(t, messages.COMMANDS, joints, position=[0.1] * len(joints)))
      fields = {"time_ns": t, "position": [np.sin(0.1 * index)] * len(joints)}
      fields = spoil(index, fields) if spoil else fields
      log.write(messages.joint_state(topic=messages.STATES, names=joints, **fields))
  if cut is not None:
    path.write_bytes(path.read_bytes()[:cut])
  return path


def _at(which, **changes):
  return lambda index, fields: {**fields, **changes} if index == which else fields


@pytest.mark.parametrize(
  ("options", "words"),
  [
    ({"commands": False}, "has no commands"),
    ({"joints": ("elbow",)}, "['elbow'] that the model lacks"),
    ({"spoil": _at(50, position=[np.nan])}, "NaN or infinite positions"),
    ({"spoil": _at(50, time_ns=START)}, "time runs backwards"),
    ({"duration": 0.1}, "expected at least 1 s"),
    ({"spoil": lambda index, fields: {**fields, "time_ns": START + index * 10**9}}, "a second"),
    ({"cut": 2000}, "truncated or damaged"),
    ({"cut": 0}, "is empty"),
  ],
)
def test_a_bad_log_is_one_line(options, words, identify, tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  log = _log(tmp_path / "bad.mcap", **options)
  code, out, err = identify(
    "--model", tmp_path / "model.xml", "--logs", log, "--out", tmp_path / "out"
  )
  assert code != 0 and out == ""
  assert err.startswith("error: bad.mcap") and err.count("\n") == 1
  assert words in err


@pytest.mark.parametrize(
  ("model", "words"),
  [
    (None, "Found no file"),
    ("<mujoco><nonsense/></mujoco>", "is not a MuJoCo model"),
    ("not xml", "is not a MuJoCo model"),
    (NO_ACTUATOR, "no actuator of the model drives that joint"),
  ],
)
def test_a_bad_model_is_one_line(model, words, identify, tmp_path):
  if model is not None:
    (tmp_path / "model.xml").write_text(model)
  log = _log(tmp_path / "a.mcap")
  code, _, err = identify(
    "--model", tmp_path / "model.xml", "--logs", log, "--out", tmp_path / "out"
  )
  assert code != 0
  assert err.startswith("error: ") and err.count("\n") == 1 and words in err


def test_missing_files_and_options_are_one_line(identify, tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  log = _log(tmp_path / "a.mcap")
  model = ("--model", tmp_path / "model.xml")
  out = ("--out", tmp_path / "out")
  (tmp_path / "file").write_text("")
  for arguments, words in (
    ((*model, *out), "Found no --model, --logs or --out"),
    ((*model, "--logs", tmp_path / "none.mcap", *out), "Found no file"),
    ((*model, "--logs", log, "--held", tmp_path / "none.mcap", *out), "Found no file"),
    ((*model, "--logs", log, "--out", tmp_path / "file"), "is a file, expected a folder"),
    (("--evaluate", tmp_path, "--held", log), "expected a folder that identify.py wrote"),
    (("--evaluate", tmp_path), "Found no --held log"),
  ):
    code, _, err = identify(*arguments)
    assert code != 0
    assert err.startswith("error: ") and err.count("\n") == 1 and words in err


def test_logs_without_motion_are_one_line(identify, tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  log = _log(tmp_path / "a.mcap", spoil=lambda index, fields: {**fields, "position": [0.5]})
  code, _, err = identify(
    "--model", tmp_path / "model.xml", "--logs", log, "--out", tmp_path / "out"
  )
  assert code != 0
  assert err.startswith("error: Found no commanded joint that moves in a.mcap")
  assert err.count("\n") == 1


@pytest.mark.parametrize("option", ["--held", "--reference"])
def test_held_logs_of_other_joints_are_one_line(option, identify, tmp_path):
  (tmp_path / "model.xml").write_text(ARM)
  log = _log(tmp_path / "a.mcap", joints=("shoulder", "elbow"))
  other = _log(tmp_path / "b.mcap", joints=("elbow",))
  code, _, err = identify(
    "--model", tmp_path / "model.xml", "--logs", log, option, other, "--out", tmp_path / "out"
  )
  assert code != 0
  assert err.startswith("error: b.mcap has no commands for ['shoulder']") and err.count("\n") == 1


def test_words_and_paths_are_told_as_they_are(capsys, tmp_path):
  """Rich takes brackets for styles, and breaks a path where a line of a pipe would end."""
  content = {
    "verdict": "none",
    "seconds": 1.0,
    "effects": [],
    "notes": ["held[a].mcap has a bias of 0.1 [rad]."],
    "error": {"train": {"before": 0.00172, "after": 6.1e-05}, "held": None, "floor": 3.2e-06},
  }
  out = tmp_path / "a folder with a long name" / "another one that is as long [as this]"
  script._print_content(content, out)
  told = capsys.readouterr().out
  assert "note: held[a].mcap has a bias of 0.1 [rad].\n" in told
  assert "train: 0.00172 -> 6.1e-05 rad" in told  # of a slide, m: micrometres count
  assert f"floor: 3.2e-06; report: {out / 'report.html'}\n" in told


def test_what_predicts_the_same_is_told_beside_what_was_found(capsys, tmp_path):
  delay = {"delay": {"value": 0.0083, "low": 0.002, "high": 0.0106, "unit": "s"}}
  content = {
    "verdict": "effects",
    "seconds": 1.0,
    "effects": [{"kind": "measurement_delay", "joint": "pitch", "parameters": delay}],
    "alternatives": [{"kind": "command_delay", "joint": "pitch", "confounded": True}],
    "notes": [],
    "error": {"train": {"before": 0.01, "after": 0.001}, "held": None, "floor": 0.001},
  }
  script._print_content(content, tmp_path)
  assert "These logs do not tell it from command delay.\n" in capsys.readouterr().out
