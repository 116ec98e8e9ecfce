"""Sets of the servo bench: the same from the same seed, readable, visible, as they say."""

import mujoco
import numpy as np
import pytest

from benchmarks.blind_sets import scoring
from benchmarks.servo_bench import bench, effects, recording, sets, simulation
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.suite.effects.registry import KINDS

TRAINED = ["train_1_sweep", "train_2_slow", "train_3_steps"]
REFERENCES = [name.replace("train", "reference") for name in TRAINED]


def contents(folder):
  return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
  folder = tmp_path_factory.mktemp("set")
  return folder, sets.make_set(folder, seed=4, index=1, mix="healthy").answer


def test_a_set_has_model_and_logs_that_open(made):
  folder, answer = made
  expected = ["held_1_points", "held_2_noise", *REFERENCES, *TRAINED]
  assert [path.stem for path in sorted(folder.glob("*.mcap"))] == expected
  model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
  assert model.joint(bench.JOINT).id == 0
  for name in expected:
    log = read_log(folder / f"{name}.mcap")
    assert log.joints == (bench.JOINT,)
    assert log.duration > 11.5
    assert np.ptp(log.states.position) > 0.3
  assert answer["mix"] == "healthy" and answer["effects"] == []


def test_a_healthy_machine_is_near_its_declared_model(made):
  _, answer = made
  assert 2e-3 < answer["held_error"] < 0.04
  assert answer["held_error"] == answer["healthy_held_error"]
  assert answer["healthy_error_true_constants"] < 8e-3
  assert answer["error_ratio"] == 1.0


def test_the_same_seed_and_index_give_the_same_bytes(made, tmp_path):
  folder, answer = made
  again = sets.make_set(tmp_path / "again", seed=4, index=1, mix="healthy").answer
  assert again == answer
  assert contents(tmp_path / "again") == contents(folder)
  other = sets.make_set(tmp_path / "other", seed=4, index=2, mix="healthy", reference=False).answer
  assert other["held_error"] != answer["held_error"]
  assert not list((tmp_path / "other").glob("reference*"))


@pytest.mark.parametrize("same_day", [True, False])
def test_references_of_the_same_day_are_of_the_same_machine(same_day):
  scene = sets._draw_scene("hanging", np.random.default_rng(1), (1,), same_day=same_day)
  assert (scene.machine.bench == scene.reference.bench) == same_day
  name = "held_1_points"
  now, before = (sets._record(scene, scene.machine, name, reference=r) for r in (False, True))
  assert not np.array_equal(now.angle, before.angle)  # other noise


def test_the_kinds_are_the_librarys_and_others():
  assert len(effects.LIBRARY) >= 12 and len(effects.OUTSIDE) >= 5
  assert set(effects.LIBRARY) <= set(KINDS)
  assert not set(effects.OUTSIDE) & set(KINDS)


@pytest.mark.parametrize("name", [*effects.LIBRARY, *effects.OUTSIDE])
def test_every_kind_changes_what_is_read_and_only_then(name):
  kind = {**effects.LIBRARY, **effects.OUTSIDE}[name]
  random = np.random.default_rng(11)
  paper = bench.on_paper(kind.plants[0], random)
  host = recording.draw_host(paper.bench.motor, random)
  machine = effects.Machine(paper, bench.copy_of(paper, random), host)
  changed, parameters = kind.apply(machine, 1.0, random.random(4))
  times = recording.command_times(host, 4.0)
  command = 0.7 * np.sin(4.0 * times)
  logs = [recording.record(m.bench, m.host, command, _same()) for m in (machine, changed)]
  shift = [np.interp(logs[0].time, log.stamp, log.angle) for log in logs]
  assert np.sqrt(np.mean((shift[1] - shift[0]) ** 2)) > 3e-4
  if name in effects.LIBRARY:
    known = {parameter.name for parameter in KINDS[name].parameters}
    sized = [size for size in scoring.SIZES[name] if size in parameters]
    assert set(sized) <= known
    assert sized or name in ("supply_sag", "thermal_derating")
  assert len(simulation.simulate.signatures) == 1


def _same():
  return np.random.default_rng(1)


@pytest.mark.parametrize(
  ("mix", "among"),
  [
    ("single", ["viscous_friction", "supply_sag"]),
    ("pair", ["command_delay", "measurement_delay", "payload"]),
    ("outside", ["host_stall"]),
  ],
)
def test_faulty_sets_say_what_they_have_and_it_shows(mix, among, tmp_path):
  answer = sets.make_set(
    tmp_path, seed=4, index=5, mix=mix, kinds=among, reference=False, plants=["hanging"]
  ).answer
  source = effects.OUTSIDE if mix == "outside" else effects.LIBRARY
  kinds = [entry["kind"] for entry in answer["effects"]]
  assert len(kinds) == (2 if mix == "pair" else 1) and set(kinds) <= set(among) & set(source)
  assert len({source[kind].group for kind in kinds}) == len(kinds)
  assert not answer["below_floor"]
  if mix != "pair":  # two effects may make up for each other in part
    assert answer["error_ratio"] >= sets.LEAST_RATIO - 0.01
  report = {
    "verdict": "unexplained" if mix == "outside" else "effects",
    "joints": [bench.JOINT],
    "effects": [] if mix == "outside" else answer["effects"],
  }
  score = scoring.score(answer, report)
  assert score.none_wrong
  assert {"single": score.right_first, "pair": score.all_right, "outside": score.unexplained}[mix]


def test_choices_that_are_not_there_are_refused(tmp_path):
  with pytest.raises(ValueError, match="trampoline"):
    sets.make_set(tmp_path, seed=0, index=0, plants=["trampoline"])
  with pytest.raises(ValueError, match="gravity_tilt"):
    sets.make_set(
      tmp_path, seed=0, index=0, mix="single", plants=["hanging"], kinds=["gravity_tilt"]
    )
