"""Later logs of the same machine fit a stored result, those of a changed one do not."""

import dataclasses
import itertools
import json
import os
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real import sysid
from nerf2real.core.robot_logs.reading import LogError
from nerf2real.launch import identify as script
from nerf2real.suite.effects import Effect
from nerf2real.suite.effects.files import to_list
from nerf2real.sysid.data.opening import load_model
from nerf2real.sysid.drift import page
from nerf2real.sysid.drift.judgement import Drift, Error
from nerf2real.sysid.drift.stored import joint_of, model_marks, read, to_json
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter, Layout
from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from tests.sysid.synthetic import ARM, COUNT, PENDULUM, log_of

FRICTION = 0.25  # N m
LATE, WIDE = 0.03, 0.003  # s, a delay and half of its interval
ZERO = 0.05  # rad
KINDS = ("sweep", "slow", "steps")


def rubs(torque):
  return [Effect("coulomb_friction", "joint", {"torque": torque})]


def carries(torque):
  return [*rubs(torque), Effect("payload", "arm", {"mass": 0.2, "x": 0.0, "y": 0.0, "z": -0.2})]


def recorded(name, xml, kind, effects, *, seed, size=1.0):
  """Returns a log of a machine with effects under commands of a size."""
  log = log_of(xml, kind, seed=seed)
  commands = dataclasses.replace(log.commands, position=size * log.commands.position)
  log = dataclasses.replace(log, commands=commands, name=name)
  positions = simulation.simulate(mujoco.MjModel.from_xml_string(xml), log, effects)
  positions = np.round(positions / COUNT) * COUNT
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=positions))


def store(folder, xml, effects, kind, values, *, shared=False, target=None):
  """Writes a result with one named effect, fitted where the truth is; returns its folder.

  What `identify` writes is tested with it (`slow`); here only what is read of it is written.
  """
  model = mujoco.MjModel.from_xml_string(xml)
  logs = [recorded(k, xml, k, effects, seed=i) for i, k in enumerate(KINDS)]
  held = [recorded("held", xml, "sweep", effects, seed=7)]
  (folder / "model.xml").write_text(xml)
  kept, rows = [], []
  for name in logs[0].joints:
    both = [JointLikelihood(JointModel(model, name, some)) for some in (logs, held)]
    own = constants(both[0].plant)
    term = next(t for t in library(both[0].plant) if t.kind == kind)
    term = dataclasses.replace(term, target=target or term.target)
    x = np.concatenate([own.starts[0], values])
    both[0].rescale(both[0].residuals((own, term), x[None])[0])
    fit = Fitter(both[:1], Layout([(own, term)])).fit(x, iterations=4)
    bounds = intervals.intervals(both[0], fit, term, own_latency=False)
    if shared:
      bounds = {n: (v - WIDE, v + WIDE) for n, v in zip(term.names, values, strict=True)}
      held_term = dataclasses.replace(term.held_at(np.array(values)), target=target, known=True)
      kept.append(joint_of(both, (own, held_term), fit.x[: len(own.names)]))
    else:
      kept.append(joint_of(both, (own, term), fit.x))
    found = fit.values(term)
    parameters = {
      n: {"value": found[n], "low": bounds[n][0], "high": bounds[n][1], "unit": term.unit(n)}
      for n in term.names
    }
    evidence = {"joints": list(logs[0].joints)} if shared else {}
    rows.append(
      {
        "kind": kind,
        "joint": target if shared else name,
        "evidence": evidence,
        "parameters": parameters,
      }
    )
  content = {"effects": rows[:1], "window_s": None}
  details = {
    "model": str(folder / "model.xml"),
    "extended": to_list(effects),
    "clocks": {},
    "joints": to_json(kept),
  }
  (folder / "report.json").write_text(json.dumps(content))
  (folder / "details.json").write_text(json.dumps(details, allow_nan=False))
  return folder


@pytest.fixture
def later(monkeypatch):
  """Logs by the name of their file, which may be added to."""
  files = {
    name: recorded(name, PENDULUM, "steps", effects, seed=11)
    for name, effects in (
      ("same.mcap", rubs(FRICTION)),
      ("rubs_more.mcap", rubs(0.4)),
      ("rubs_no_more.mcap", []),
      ("carries.mcap", carries(FRICTION)),
    )
  }
  monkeypatch.setattr("nerf2real.sysid.data.opening.read_log", lambda path: files[Path(path).name])
  return files


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
  folder = tmp_path_factory.mktemp("pendulum")
  return store(folder, PENDULUM, rubs(FRICTION), "coulomb_friction", [FRICTION])


def test_a_later_log_of_the_same_machine_fits(pendulum, later, tmp_path):
  found = sysid.check_drift(pendulum, [Path("same.mcap")], out=tmp_path)
  assert found.holds and found.not_judged == ()
  (value,) = found.values
  assert value.state == "fits" and value.later is not None
  assert value.later[0] == pytest.approx(FRICTION, abs=0.02)
  (error,) = found.errors
  assert error.later < error.expected < 5 * error.stored
  assert page.sentence(found).startswith("The stored result still holds")
  kept = json.loads((tmp_path / "drift.json").read_text())
  assert kept["holds"] is True and kept["values"][0]["name"] == "torque"
  written = (tmp_path / "drift.html").read_text()
  assert "Does the stored result still hold?" in written and ">Yes<" in written


def test_a_value_beyond_its_interval_is_drift(pendulum, later, tmp_path):
  found = sysid.check_drift(pendulum, [Path("rubs_more.mcap")], out=tmp_path)
  (value,) = found.moved
  assert (value.kind, value.where, value.name) == ("coulomb_friction", "joint", "torque")
  assert value.later is not None and value.stored[2] < value.later[0]
  assert value.later[0] == pytest.approx(0.4, abs=0.04)
  words = page.sentence(found)
  assert words.startswith("The machine has drifted: coulomb_friction torque at joint is 0.4")
  assert json.loads((tmp_path / "drift.json").read_text())["holds"] is False


def test_an_effect_that_is_gone_is_drift(pendulum, later, tmp_path):
  found = sysid.check_drift(pendulum, [Path("rubs_no_more.mcap")], out=tmp_path)
  (value,) = found.moved
  assert value.later is not None and value.later[0] < 0.05


def test_what_no_stored_effect_holds_is_drift_of_the_error(pendulum, later, tmp_path):
  found = sysid.check_drift(pendulum, [Path("carries.mcap")], out=tmp_path)
  (error,) = found.grown
  assert error.later > error.expected
  assert "were expected" in page.sentence(found)


def test_noisier_readings_are_no_drift(pendulum, later, tmp_path):
  log, random = later["same.mcap"], np.random.default_rng(0)
  noise = 8 * COUNT * random.normal(size=log.states.position.shape)
  states = dataclasses.replace(log.states, position=log.states.position + noise)
  later["loud.mcap"] = dataclasses.replace(log, states=states, name="loud.mcap")
  found = sysid.check_drift(pendulum, [Path("loud.mcap")], out=tmp_path)
  (error,) = found.errors
  assert error.later > error.expected  # of the first readings
  assert found.holds


def test_a_threshold_that_is_not_reached_is_not_judged(later, tmp_path):
  limit = [Effect("torque_limit", "joint", {"limit": 1.5})]
  folder = store(tmp_path, PENDULUM, limit, "torque_limit", [1.5])
  later["strong"] = recorded("strong", PENDULUM, "sweep", limit, seed=5)
  later["gentle"] = recorded("gentle", PENDULUM, "slow", limit, seed=5, size=0.3)
  (value,) = sysid.check_drift(folder, [Path("strong")]).values
  assert value.state == "fits"
  found = sysid.check_drift(folder, [Path("gentle")])
  (value,) = found.values
  assert found.holds and value.state == "not shown" and value.later is None
  assert "not shown by these logs: torque_limit limit" in page.sentence(found)


def test_the_command_says_it_and_ends_with_its_status(pendulum, later, tmp_path, capsys):
  def run(name):
    arguments = script.Arguments(evaluate=pendulum, held=(Path(name),), out=tmp_path)
    status = script.run(arguments)
    return status, " ".join(capsys.readouterr().out.split())

  status, words = run("same.mcap")
  assert status == 0 and "The stored result still holds" in words and "same.mcap" in words
  status, words = run("rubs_more.mcap")
  assert status == script.DRIFTED == 3 and "The machine has drifted" in words


def test_a_log_without_the_joint_or_an_older_result_is_one_clear_error(pendulum, later, tmp_path):
  other = PENDULUM.replace('"joint"', '"other"')
  later["other"] = log_of(other, "slow", duration=3.0)
  with pytest.raises(LogError, match=r"the joints \['other'\] that the model lacks"):
    sysid.check_drift(pendulum, [Path("other")], out=tmp_path)
  assert read(pendulum).joints[0].logs[-1].fitted is False
  for name in ("report.json", "details.json"):
    (tmp_path / name).write_text((pendulum / name).read_text())
  details = json.loads((tmp_path / "details.json").read_text())
  del details["joints"]
  (tmp_path / "details.json").write_text(json.dumps(details))
  with pytest.raises(ValueError, match="expected a result of this version"):
    sysid.check_drift(tmp_path, [Path("same.mcap")])


def test_a_model_whose_included_file_or_mesh_changed_is_refused(pendulum, tmp_path):
  """By another MuJoCo, and in results of earlier versions, the file alone tells."""
  arm = PENDULUM[PENDULUM.index("<body") : PENDULUM.index("</worldbody>")]
  mesh = '<asset><mesh name="hull" file="hull.obj"/></asset>'
  xml = PENDULUM.replace(arm, '<include file="arm.xml"/>').replace(
    "<worldbody>", f"{mesh}<worldbody>"
  )
  arm = arm.replace("</body>", '<geom type="mesh" mesh="hull" mass="0"/></body>')
  corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
  written = itertools.count()
  faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"

  def write(declared=xml, included=arm, hull=corners):
    (tmp_path / "model.xml").write_text(declared)
    (tmp_path / "arm.xml").write_text(f"<mujoco>{included}</mujoco>")
    (tmp_path / "hull.obj").write_text(hull + faces)
    seconds = time.time() + 10 * next(written)  # MuJoCo reads a mesh again when its second differs
    os.utime(tmp_path / "hull.obj", (seconds, seconds))

  write()
  path = tmp_path / "model.xml"
  details = json.loads((pendulum / "details.json").read_text())
  details |= {"model": str(path), **model_marks(path, load_model(path))}
  (tmp_path / "report.json").write_text((pendulum / "report.json").read_text())
  (tmp_path / "details.json").write_text(json.dumps(details))
  heavier, longer = arm.replace('mass="0.5"', 'mass="0.7"'), corners.replace("v 0 0 1", "v 0 0 2")
  read(tmp_path)
  for change in ({"included": heavier}, {"hull": longer}, {"declared": xml.replace("21", "22")}):
    write(**change)
    with pytest.raises(ValueError, match=r"or a file that it includes, changed since") as caught:
      read(tmp_path)
    assert "\n" not in str(caught.value)
  write(declared=xml.replace("<worldbody>", "<!-- a remark --><worldbody>"))
  read(tmp_path)
  old = {key: value for key, value in details.items() if not key.startswith("compiled")}
  for earlier in ({**details, "compiled_by": "1.0"}, old):
    (tmp_path / "details.json").write_text(json.dumps(earlier))
    write(included=heavier)
    read(tmp_path)
    write(declared=xml.replace("21", "22"))
    with pytest.raises(ValueError, match="changed since"):
      read(tmp_path)


def test_an_effect_of_the_machine_is_fitted_to_all_joints(later, tmp_path):
  late = [Effect("command_delay", None, {"delay": LATE})]
  folder = store(tmp_path, ARM, late, "command_delay", [LATE], shared=True)
  for name, delay in (("same", LATE), ("later", LATE + 0.02)):
    effects = [Effect("command_delay", None, {"delay": delay})]
    later[name] = recorded(name, ARM, "sweep", effects, seed=9)
  assert sysid.check_drift(folder, [Path("same")]).holds
  (value,) = sysid.check_drift(folder, [Path("later")]).moved
  assert value.later is not None and value.where == "all"
  assert value.later[0] == pytest.approx(LATE + 0.02, abs=0.004)
  states = later["same"].states
  frozen = states.position * (1.0, 0.0) + (0.0, 0.3)
  later["still"] = dataclasses.replace(
    later["same"], states=dataclasses.replace(states, position=frozen)
  )
  found = sysid.check_drift(folder, [Path("still")])
  assert found.not_judged == ("elbow, which does not move in these logs",)
  assert [error.joint for error in found.errors] == ["shoulder"]


def test_a_zero_that_a_tilt_was_told_as_is_fitted_anew(later, tmp_path):
  tilted = [Effect("gravity_tilt", None, {"x": 0.0, "y": ZERO})]
  folder = store(tmp_path, ARM, tilted, "gravity_tilt", [0.0, ZERO], shared=True)
  content = json.loads((folder / "report.json").read_text())
  (row,) = content["effects"]
  offset = row["parameters"].pop("y")
  row |= {"kind": "encoder_offset", "joint": "shoulder", "parameters": {"offset": offset}}
  (folder / "report.json").write_text(json.dumps(content))
  for name, zero in (("same", ZERO), ("later", ZERO + 0.1)):
    effects = [Effect("encoder_offset", "shoulder", {"offset": zero})]
    later[name] = recorded(name, ARM, "sweep", effects, seed=9)
  same = sysid.check_drift(folder, [Path("same")])
  assert same.holds and not same.not_judged
  (value,) = sysid.check_drift(folder, [Path("later")]).moved
  assert (value.kind, value.where, value.name) == ("encoder_offset", "shoulder", "offset")
  assert value.later is not None and value.later[0] == pytest.approx(ZERO + 0.1, abs=0.02)


def test_a_zero_that_its_chain_feels_is_fitted_anew(later, tmp_path):
  shifted = [Effect("encoder_offset", "elbow", {"offset": ZERO})]
  folder = store(tmp_path, ARM, shifted, "encoder_offset", [ZERO], shared=True, target="elbow")
  for name, zero in (("same", ZERO), ("later", ZERO + 0.1)):
    effects = [Effect("encoder_offset", "elbow", {"offset": zero})]
    later[name] = recorded(name, ARM, "sweep", effects, seed=9)
  same = sysid.check_drift(folder, [Path("same")])
  assert same.holds and not same.not_judged
  (value,) = sysid.check_drift(folder, [Path("later")]).moved
  assert (value.kind, value.where, value.name) == ("encoder_offset", "elbow", "offset")
  assert value.later is not None and value.later[0] == pytest.approx(ZERO + 0.1, abs=0.005)


@pytest.mark.slow
def test_what_identify_writes_is_judged(later, tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  for seed, kind in enumerate((*KINDS, "sweep")):
    later[f"{seed}"] = recorded(f"{seed}", PENDULUM, kind, rubs(FRICTION), seed=seed)
  content = sysid.identify(
    tmp_path / "model.xml", [Path(str(i)) for i in range(3)], held=[Path("3")], out=tmp_path / "out"
  )
  assert [row["kind"] for row in content["effects"]] == ["coulomb_friction"]
  assert sysid.check_drift(tmp_path / "out", [Path("same.mcap")]).holds
  moved = sysid.check_drift(tmp_path / "out", [Path("rubs_more.mcap")]).moved
  assert [value.kind for value in moved] == ["coulomb_friction"]
  (tmp_path / "model.xml").write_text(PENDULUM.replace('mass="0.5"', 'mass="0.7"'))
  with pytest.raises(ValueError, match=r"model\.xml, or a file that it includes, changed since"):
    sysid.check_drift(tmp_path / "out", [Path("same.mcap")])


def test_the_sentence_names_what_grew_most():
  errors = (
    Error("a", "rad", 1e-3, 2e-3, 1.5e-3, 1e-4, 1e-4, False),
    Error("b", "m", 1e-3, 2e-3, 3e-3, 1e-4, 1e-4, True),
  )
  words = page.sentence(Drift(("x",), errors, (), ()))
  assert words == "The machine has drifted: b leaves 3 mm, at most 2 mm were expected."
