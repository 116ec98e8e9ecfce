"""The loop with a policy from end to end: going on from a finding, and whole (slow)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerf2real.evaluation.episodes import FILE, Store
from nerf2real.evaluation.loop import story
from nerf2real.evaluation.loop.robot import recording
from nerf2real.evaluation.loop.settings import LoopSettings, claim
from nerf2real.suite.effects import Effect, write_effects

SCRIPT = Path(__file__).parents[3] / "launch" / "close_loop.py"


def _run(out, *extra):
  command = [sys.executable, str(SCRIPT), "--policy", "walker", "--preset", "tiny", "--trials", "1"]
  command += ["--minutes", "0.3", "--time-limit", "1", "--teacher", "quick", "--out", str(out)]
  environment = os.environ | {"PYTHONPATH": str(SCRIPT.parents[1])}
  return subprocess.run(
    [*command, *extra], env=environment, capture_output=True, text=True, timeout=1800
  )


def _found_before(out, effects, verdict, hidden=()):
  """Leaves logs and a finding as an interrupted loop does."""
  claim(LoopSettings(policy="walker", hidden=hidden, time_limit=1.0, out=out))
  for folder in ("stand", "reference"):
    (out / folder).mkdir(parents=True)
    for name in (*recording.TRAIN, *recording.HELD, recording.FLOOR):
      (out / folder / f"{name}.mcap").write_bytes(b"")
  (out / "identified").mkdir()
  write_effects(out / "identified" / "effects.json", effects)
  error = {"held": {"before": 0.004, "after": 0.001}, "floor": 0.0005, "train": None}
  content = {"verdict": verdict, "error": error, "notes": [], "seconds": 1.0}
  (out / "identified" / "finding.json").write_text(json.dumps(content))


def _succeeds(out, plant_id):
  """Makes a success of the kept episode of one plant, as if that robot had reached its goal."""
  path = out / FILE
  lines = [json.loads(line) for line in path.read_text().splitlines()]
  (line,) = [line for line in lines if line["setting"]["plant_id"] == plant_id]
  line["outcome"] = "success"
  path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


@pytest.mark.slow
def test_a_loop_goes_on_from_its_finding_and_ends_with_the_page(tmp_path):
  delay = Effect("command_delay", None, {"delay": 0.04}, {"delay": (0.035, 0.05)})
  _found_before(tmp_path, [delay], "effects", hidden=("command_delay:0.045",))
  first = _run(tmp_path, "--hidden", "command_delay:0.045")
  assert first.returncode == 0, first.stdout + first.stderr
  assert "no success was lost: the policy stays" in first.stdout  # in a second nobody gets there
  assert not (tmp_path / "training").exists()
  _succeeds(tmp_path, "robot 1")
  found = _run(tmp_path, "--hidden", "command_delay:0.045")
  assert found.returncode == 0, found.stdout + found.stderr
  before_the_end, _, end = found.stdout.partition("success, robot as it was")
  assert "0.045" not in before_the_end and "hidden: command_delay:0.045" in end
  summary = json.loads((tmp_path / "loop.json").read_text())
  assert set(summary["success"]) == {
    story.HEALTHY,
    story.BEFORE,
    story.NOMINAL,
    story.WITH_EFFECTS,
    story.TRAINED,
    story.AFTER,
  }
  assert summary["trained"]["teacher"] == "quick" and summary["trained"]["frames"] > 0
  assert summary["hidden"]["rows"][0]["right"] and summary["hidden"]["wrong"] == []
  assert (tmp_path / "loop.html").stat().st_size > 10_000
  assert len(list((tmp_path / "trials").glob("*.mcap"))) == 3  # all runs on the robot
  kept = [episode.key for episode in Store(tmp_path).episodes]
  assert len(kept) == len(set(kept)) == 6
  again = _run(tmp_path, "--hidden", "command_delay:0.045")  # nothing is repeated
  assert again.returncode == 0, again.stdout + again.stderr
  assert [episode.key for episode in Store(tmp_path).episodes] == kept
  assert "trials to run" not in again.stdout


@pytest.mark.slow
def test_where_nothing_is_named_the_policy_stays(tmp_path):
  _found_before(tmp_path, [], "none")
  found = _run(tmp_path)
  assert found.returncode == 0, found.stdout + found.stderr
  summary = json.loads((tmp_path / "loop.json").read_text())
  assert summary["trained"] is None and summary["recovered"] is None
  counts = [summary["success"][name] for name in (story.HEALTHY, story.BEFORE, story.AFTER)]
  assert len({count["successes"] for count in counts}) == 1
  assert not (tmp_path / "training").exists()


@pytest.mark.slow
def test_the_whole_loop_names_what_it_finds_in_its_own_recordings(tmp_path):
  found = _run(tmp_path, "--hidden", "command_delay:0.045", "--seconds", "6")
  assert found.returncode == 0, found.stdout + found.stderr
  summary = json.loads((tmp_path / "loop.json").read_text())
  assert summary["verdict"] != "none"
  (delay,) = [effect for effect in summary["effects"] if effect["kind"] == "command_delay"]
  low, high = delay["intervals"]["delay"]
  assert low < 0.05 and high > 0.04
