"""What the second generator writes: readable logs of declared models, truths that hold."""

import json
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from benchmarks.blind_sets import scoring
from benchmarks.independent_sets import apparatus, declared, effects, machine, recording, sets
from benchmarks.ledger.records import ROOT
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.suite.effects import KINDS
from nerf2real.sysid.data.compatibility import check_against_model

NAMES = (
  *("held_1_points", "reference_1_chirp", "reference_2_trapezoids", "reference_3_steps"),
  *("train_1_chirp", "train_2_trapezoids", "train_3_steps"),
)


@pytest.fixture(autouse=True)
def _short(monkeypatch):
  monkeypatch.setattr(sets, "DURATION", 1.4)
  monkeypatch.setattr(sets, "SETTLING", 0.2)


@pytest.mark.parametrize(
  ("plant", "kind"), [("slider", "torque_limit"), ("arm", "payload"), ("wheel", "supply_sag")]
)
def test_a_set_is_what_the_analyser_reads(plant, kind, tmp_path):
  truth = sets.make_set(
    tmp_path / "a", seed=5, index=1, mix="single", plants=(plant,), kinds=(kind,)
  )
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "a/model.xml"))
  files = sorted((tmp_path / "a").glob("*.mcap"))
  assert [file.stem for file in files] == list(NAMES)
  for file in files:
    log = read_log(file)
    check_against_model(log, model)
    assert np.ptp(log.states.position, axis=0).max() > 1e-3
    steps = np.diff(log.states.stamp)
    assert steps.min() >= 0 and steps.std() > 1e-5  # jitter
    if kind == "supply_sag":
      assert (np.ptp(log.battery.value) > 0) == (not file.stem.startswith("reference"))
  (effect,) = truth.answer["effects"]
  assert effect["kind"] == kind and truth.answer["plant"] == plant
  said = {"verdict": "effects", "effects": [{**effect, "parameters": {}}]}
  if plant == "slider":
    said["effects"][0]["parameters"] = {"limit": {"value": effect["limit"]}}
  score = scoring.score(truth.answer, said)
  assert score.right_first and score.none_wrong
  assert plant != "slider" or score.size_errors == [0.0]


def test_seed_and_index_decide_a_set(tmp_path):
  for name in ("a", "b"):
    truth = sets.make_set(tmp_path / name, seed=6, index=2, mix="pair", plants=("wheel",))
  first, second = truth.answer["effects"]
  assert first["kind"] != second["kind"]
  for file in (tmp_path / "a").iterdir():
    assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_effects_have_the_librarys_names_and_parameters():
  rng = np.random.default_rng(0)
  for plant in apparatus.KINDS:
    paper = apparatus.make_apparatus(plant, rng)
    for kind, maker in effects.LIBRARY.items():
      if plant not in maker.plants:
        continue
      effect = effects.draw(kind, rng, paper, 0)
      names = {p.name for p in KINDS[kind].parameters}
      assert set(effect.values) <= names
      entry = effects.describe(effect, paper)
      assert "in_library" not in entry and (entry["joint"] in paper.joints or maker.shared)
    for kind in effects.OUTSIDE:
      assert kind not in KINDS


def test_every_effect_changes_its_machine():
  rng = np.random.default_rng(1)
  for plant in apparatus.KINDS:
    paper = apparatus.make_apparatus(plant, rng)
    for kind, maker in (effects.LIBRARY | effects.OUTSIDE).items():
      if plant in maker.plants:
        joint = len(paper.joints) - 1
        changed = effects.apply(paper.nominal, effects.draw(kind, rng, paper, joint), paper)
        differing = [
          n for n in vars(changed) if np.any(getattr(changed, n) != getattr(paper.nominal, n))
        ]
        assert differing, kind


def test_copies_differ_by_the_stated_scatter():
  paper = apparatus.make_apparatus("wheel", np.random.default_rng(2))
  rng = np.random.default_rng(3)
  copies = machine.stack([machine.scattered(paper.nominal, rng) for _ in range(300)])
  for name in ("torque_constant", "coulomb"):
    share = np.std(getattr(copies, name)) / getattr(paper.nominal, name)
    assert share == pytest.approx(machine.SCATTER[name], rel=0.15)


def test_the_declared_models_error_is_of_the_positions():
  xml = """<mujoco><option gravity="0 0 0" timestep="0.001"/><worldbody><body>
    <joint name="j" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
    <actuator><motor joint="j"/></actuator></mujoco>"""
  time = np.arange(0, 3, 0.005)
  nothing = np.zeros((len(time), 1))
  path = 0.25 * (time[:, None] - 0.0) ** 2  # 1 N on 2 kg
  recorded = recording.Recording(time, nothing + 1.0, time, path, None, None, None, time, None)
  assert declared.error(xml, recorded, whole=False)[0] < 1e-4
  wrong = recording.Recording(time, nothing, time, path, None, None, None, time, None)
  # Windows of 0.5 s begin with the right velocity and lack 0.5 m/s^2 from there.
  assert declared.error(xml, wrong, whole=False)[0] == pytest.approx(
    0.25 * 0.5**2 / np.sqrt(5), rel=0.03
  )


@pytest.mark.slow
def test_the_command_writes_sets_and_answers(tmp_path):
  command = [sys.executable, str(ROOT / "benchmarks/make_blind_sets.py"), "--seed", "8"]
  command += ["--generator", "independent_sets", "--count", "1", "--out", str(tmp_path)]
  subprocess.run(command, check=True, capture_output=True)
  answers = json.loads((tmp_path / "answers.json").read_text())
  assert list(answers) == ["8_000"]
  assert len(list((tmp_path / "8_000").glob("*.mcap"))) == 7
