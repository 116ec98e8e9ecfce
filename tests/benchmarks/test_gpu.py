"""The GPU checks' frame, with processes that stand in for the checks."""

import json

import pytest

from benchmarks import gpu, harness


@pytest.fixture
def no_gpu(monkeypatch):
  monkeypatch.setattr(harness, "machine", lambda: harness.Machine("cpu", 2, 8.0))


def _fake(monkeypatch, scripts):
  """Checks that are little programs; {out} is where they write their figures."""

  def commands(settings, out):
    return {
      name: ["-c", script.replace("{out}", str(out / f"{name}.json"))]
      for name, script in scripts.items()
    }

  monkeypatch.setattr(gpu, "commands", commands)


def _writes(figures):
  return f"import json; open('{{out}}', 'w').write(json.dumps({{'figures': {figures!r}}}))"


def test_without_a_gpu_it_says_so_in_a_line(no_gpu, capsys):
  assert gpu.main(gpu.Settings()) == 0
  assert capsys.readouterr().out.count("\n") == 1


def test_a_check_that_hangs_or_fails_loses_no_other(monkeypatch, no_gpu, tmp_path, capsys):
  _fake(
    monkeypatch,
    {
      "render": "import time; time.sleep(60)",
      "field": "raise RuntimeError('no memory')",
      "learner": _writes({"30x40": {"updates_per_second": 2.5}}),
    },
  )
  settings = gpu.Settings(device="cpu", limit=3.0, out=tmp_path / "gpu.json")
  assert gpu.main(settings) == 1
  said = capsys.readouterr().out
  assert "render: FAILED: took longer than 3 s" in said
  assert "field: FAILED: RuntimeError: no memory" in said
  figures = json.loads((tmp_path / "gpu.json").read_text())["figures"]
  assert figures == {"cpu_cpu_learner_paper_30x40": {"updates_per_second": 2.5}}


def test_records_carry_the_gpu_s_name(monkeypatch, tmp_path):
  machine = harness.Machine("cpu", 2, 8.0, "NVIDIA X 100", 24.0)
  monkeypatch.setattr(harness, "machine", lambda: machine)
  _fake(monkeypatch, {"render": _writes({"render_30x40": {"single_ms": 1.0}})})
  kept = []
  monkeypatch.setattr(harness.ledger, "update", lambda *arguments, **_: kept.append(arguments))
  assert gpu.main(gpu.Settings(write=True)) == 0
  topic, figures, origin = kept[0]
  assert topic == "gpu" and list(figures) == ["nvidia_x_100_render_30x40"]
  assert "NVIDIA X 100 (24 GB)" in origin["machine"]


def test_the_limits_leave_it_under_ten_minutes():
  assert sum(gpu.LIMITS.values()) < 600


def test_the_chosen_checks_run_with_their_sizes(tmp_path):
  settings = gpu.Settings(device="cpu", tiny=True, seconds=5.0, only=("render", "learner"))
  commands = gpu.commands(settings, tmp_path)
  assert list(commands) == ["render", "learner"]
  assert commands["render"][1:] == [
    *("--check", "render", "--device", "cpu", "--seconds", "5.0", "--tiny"),
    *("--out", str(tmp_path / "render.json")),
  ]
  assert commands["learner"][-1] == "30x40" and "batch_size=2" in commands["learner"]


@pytest.mark.slow
def test_all_checks_run_on_a_cpu(tmp_path, capsys):
  """The rehearsal of `python benchmarks/gpu.py`: every check for real, tiny."""
  out = tmp_path / "gpu.json"
  assert gpu.main(gpu.Settings(device="cpu", tiny=True, out=out)) == 0, capsys.readouterr().out
  figures = json.loads(out.read_text())["figures"]
  render = next(values for name, values in figures.items() if "render_30x40" in name)
  assert render["largest_difference_levels"] == 0 and render["batch_of_2_a_picture_ms"] > 0
  trained = next(values for name, values in figures.items() if "field_paper" in name)
  assert trained["steps"] == 3 and trained["held_out_psnr_db"] > 0
  fused = next(values for name, values in figures.items() if "field_fast" in name)
  assert fused["steps"] > 3 and fused["held_out_psnr_db"] > 0
  assert any("learner_paper_30x40" in name for name in figures)


def test_the_render_check_in_this_process(capsys):
  """Tiny, on the CPU against itself: the same pictures."""
  figures = gpu.check_render(gpu.Settings(device="cpu", tiny=True))
  assert figures["render_30x40"]["largest_difference_levels"] == 0
