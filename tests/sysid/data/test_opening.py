"""Logs as CSV and as BAM's JSON."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import LogError
from nerf2real.sysid.data.audit import audit
from nerf2real.sysid.data.bam import UNNAMED
from nerf2real.sysid.data.checks import check_distinct, check_length
from nerf2real.sysid.data.compatibility import check_against_model
from nerf2real.sysid.data.opening import (
  from_first_command,
  named,
  read_log,
  read_logs,
  without_fillers,
)
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.drive import command_of
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import measured
from nerf2real.sysid.model.motion import smooth_motion
from nerf2real.sysid.outputs.identify import identify
from nerf2real.sysid.sensors import floor, inertial, optical, sensing
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import ARM, PENDULUM, log_of

MEASURED = Path(__file__).parents[4] / "shared/data/measured"
TIME = 0.01 * np.arange(200)
PATH = np.sin(TIME)


def csv_of(folder, lines):
  path = folder / "log.csv"
  path.write_text("\n".join(lines) + "\n")
  return path


def rows(start=7.0):
  """Returns commands and states in rows of their own, temperature now and then."""
  lines = ["time,command_position:joint,position:joint,effort:joint,voltage,temperature:joint"]
  for index, (time, place) in enumerate(zip(TIME, PATH, strict=True)):
    heat = "31" if index % 50 == 0 else ""
    lines.append(f"{start + time:.4f},{0.5 * place:.6f},,,,")
    lines.append(f"{start + time + 0.002:.4f},,{place:.6f},{2 * place:.6f},12.1,{heat}")
  return lines


def test_a_joint_commanded_past_its_range_is_refused(tmp_path):
  stopped = np.clip(0.5 * PATH, -0.2, 0.2)
  lines = ["time,command_position:joint,position:joint"]
  lines += [f"{t:.4f},{0.5 * p:.6f},{s:.6f}" for t, p, s in zip(TIME, PATH, stopped, strict=True)]
  log = read_log(csv_of(tmp_path, lines))
  servo = '<position name="joint" joint="joint" kp="21"/>'
  for limits, refused in (('range="-11.46 11.46"', True), ('range="-60 60"', False)):
    model = mujoco.MjModel.from_xml_string(
      f'<mujoco><worldbody><body><joint name="joint" axis="0 1 0" {limits}/>'
      f'<geom size="0.1"/></body></worldbody><actuator>{servo}</actuator></mujoco>'
    )
    if refused:
      with pytest.raises(LogError, match="end of its declared range, -0.2 to 0.2"):
        check_against_model(log, model)
    else:
      check_against_model(log, model)


def test_a_csv_log(tmp_path):
  log = read_log(csv_of(tmp_path, rows()))
  assert log.joints == log.commands.joints == ("joint",)
  np.testing.assert_allclose(log.commands.stamp, TIME, atol=1e-9)
  np.testing.assert_allclose(log.states.stamp, TIME + 0.002, atol=1e-9)
  np.testing.assert_allclose(log.commands.position[:, 0], 0.5 * PATH, atol=1e-6)
  np.testing.assert_allclose(log.states.effort[:, 0], 2 * PATH, atol=1e-6)
  assert log.states.velocity is None and log.commands.effort is None and log.pwm is None
  assert set(log.battery.value) == {12.1} and len(log.temperatures["joint"].value) == 4
  (tmp_path / "m.xml").write_text(PENDULUM)
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  assert read_logs([tmp_path / "log.csv"], model)[0].duration == pytest.approx(log.duration)


def test_a_joint_that_a_tendon_alone_drives_is_not_commanded():
  start = ARM.index('<position name="elbow"')
  tied = ARM[:start] + '<position name="fingers" tendon="split" kp="9"/></actuator>'
  tied += '<tendon><fixed name="split"><joint joint="elbow" coef="1"/></fixed></tendon></mujoco>'
  with pytest.raises(LogError, match=r"by a tendon alone \(\['fingers'\]\).*leave its commands"):
    check_against_model(log_of(ARM, "slow", duration=2.0), mujoco.MjModel.from_xml_string(tied))


def test_units_stand_in_brackets(tmp_path):
  lines = ["time [ms],command_position:joint[deg],position:joint [deg],voltage [mV]"]
  for time, place in zip(TIME, np.degrees(PATH), strict=True):
    lines.append(f"{1e3 * time:.3f},{0.5 * place:.6f},{place:.6f},12100")
  log = read_log(csv_of(tmp_path, lines))
  np.testing.assert_allclose(log.states.stamp, TIME, atol=1e-9)
  np.testing.assert_allclose(log.commands.position[:, 0], 0.5 * PATH, atol=1e-6)
  np.testing.assert_allclose(log.states.position[:, 0], PATH, atol=1e-6)
  np.testing.assert_allclose(log.battery.value, 12.1)


@pytest.mark.parametrize("effort", [0.0, 0.25])
def test_what_a_driver_fills_in_is_not_measured(effort, tmp_path):
  lines = [line.replace(",12.1,", ",0,") for line in rows()]
  filled = [",".join([*(f := line.split(","))[:3], f"{effort}", *f[4:]]) for line in lines[2::2]]
  lines[2::2] = filled
  path, model = csv_of(tmp_path, lines), mujoco.MjModel.from_xml_string(PENDULUM)
  (log,) = read_logs([path], model)
  assert log.states.effort is None and log.battery is None
  lines[2::4] = [line.replace(",0,", ",12.1,") for line in lines[2::4]]
  (log,) = read_logs([csv_of(tmp_path, lines)], model)
  assert set(log.battery.value) == {12.1} and len(log.battery.stamp) == 100


@pytest.mark.parametrize("missing", [0, 1, 50])
def test_states_begin_with_the_commands(missing, tmp_path, monkeypatch):
  """One reading before the first command is of its cycle."""
  lines = rows()
  commands = [line for line in lines[1::2] if line][missing:]
  table = sorted(commands + lines[2::2], key=lambda line: float(line.split(",")[0]))
  path, model = csv_of(tmp_path, [lines[0], *table]), mujoco.MjModel.from_xml_string(PENDULUM)
  (log,) = read_logs([path], model)
  cut = missing if missing > 1 else 0
  assert len(log.states.stamp) == len(log.states.position) == len(log.states.effort) == 200 - cut
  assert (log.states.stamp[0] > log.commands.stamp[0]) == (missing != 1)
  assert len(log.whole.states.stamp) == 200 and log.whole.recorded is None
  given = []
  for sensor in (inertial, optical, floor):
    monkeypatch.setattr(sensor, "find", lambda _, logs: given.append(len(logs[0].states.stamp)))
  sensing.find(model, [log])
  assert given == [200, 200, 200]


def test_a_recorder_that_starts_before_a_step_shows_no_delay():
  """What came before the first command is not simulated under it."""
  log, model = log_of(PENDULUM, "steps", duration=4.0), mujoco.MjModel.from_xml_string(PENDULUM)
  position = np.where(log.commands.stamp[:, None] < 2.0, 0.0, 0.9)
  log = dataclasses.replace(log, commands=dataclasses.replace(log.commands, position=position))
  states = dataclasses.replace(log.states, position=simulation.simulate(model, log))
  told = log.commands.stamp >= 2.0
  commands = dataclasses.replace(
    log.commands,
    stamp=log.commands.stamp[told],
    log_time=log.commands.stamp[told],
    position=position[told],
  )
  log = dataclasses.replace(log, states=states, commands=commands)
  assert simulation.error(model, [log]) > 0.2
  assert simulation.error(model, [from_first_command(log)]) < 0.01


def test_an_effort_that_one_joint_lacks_is_not_measured():
  log = log_of(ARM, "slow", duration=1.5)
  lacking = np.full(len(log.states.stamp), np.nan)
  for other, is_kept in ((log.states.position[:, 1], True), (0.0 * lacking, False)):
    efforts = np.column_stack([lacking, np.nan_to_num(other)])
    states = dataclasses.replace(log.states, effort=efforts)
    kept = without_fillers(dataclasses.replace(log, states=states, pwm=states))
    assert (kept.states.effort is not None) == is_kept
    model, motion = mujoco.MjModel.from_xml_string(ARM), smooth_motion(log)
    of = {joint: measured(kept, motion, joint, model) for joint in log.joints}
    assert of["shoulder"].effort is None and of["shoulder"].duty is None
    assert (of["elbow"].effort is not None) == is_kept and of["elbow"].duty is not None
    assert np.isfinite(audit(kept)["saturated_share"])
    plant = JointModel(model, "elbow", [kept])
    sagging = plant.declared.copy()
    sagging[INDEX["droop"]] = 0.05  # by what the other joints draw, too
    assert np.isfinite(plant.run(sagging, (), 0).position).all()


def test_a_log_that_is_given_twice_is_refused(tmp_path):
  one, two = tmp_path / "one.csv", tmp_path / "two.csv"
  one.write_text("\n".join(rows()) + "\n")
  two.write_text("\n".join(rows(start=8.0)) + "\n")
  (tmp_path / "copy.csv").write_text(one.read_text())
  (tmp_path / "model.xml").write_text(PENDULUM)
  check_distinct([one, two, tmp_path / "none.csv", tmp_path / "none.csv"])
  for train, held, said in (([one, one], [], "one.csv is given twice"), ([two, one], ["copy"], "")):
    paths = [tmp_path / f"{name}.csv" for name in held]
    with pytest.raises(LogError, match=said or r"copy\.csv and .*one\.csv are the same") as caught:
      identify(tmp_path / "model.xml", train, held=paths, out=tmp_path / "out")
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_an_effort_that_never_changes_beside_one_that_does_is_not_measured():
  log = log_of(ARM, "slow", duration=1.5)
  efforts = np.column_stack([np.zeros(len(log.states.stamp)), log.states.position[:, 1]])
  log = dataclasses.replace(log, states=dataclasses.replace(log.states, effort=efforts))
  model, motion = mujoco.MjModel.from_xml_string(ARM), smooth_motion(log)
  assert measured(log, motion, "shoulder", model).effort is None
  assert measured(log, motion, "elbow", model).effort is not None


def test_columns_without_values_and_gaps_in_velocities_are_no_errors(tmp_path):
  names = "time,command_position:joint,command_effort:joint,position:joint,velocity:joint"
  lines = [f"{names},effort:joint"]
  for index, (t, p) in enumerate(zip(TIME, PATH, strict=True)):
    lines.append(f"{t:.4f},{0.5 * p:.6f},,{p:.6f},{'' if index % 3 else '0.1'},")
  log = read_log(csv_of(tmp_path, lines))
  assert len(log.states.stamp) == len(TIME) and log.states.effort is None
  assert log.commands.effort is None and log.commands.position is not None
  empty = [lines[0], *(",".join([(f := line.split(","))[0], "", *f[2:]]) for line in lines[1:])]
  with pytest.raises(LogError, match="no column command_position:JOINT or .* with values, found"):
    read_log(csv_of(tmp_path, empty))


def test_joints_of_one_machine_are_commanded_by_what_each_takes(tmp_path):
  lines = ["time,command_position:shoulder,command_velocity:elbow,position:shoulder,position:elbow"]
  lines += [
    f"{t:.4f},{0.5 * p:.6f},{2 * p:.6f},{p:.6f},{3 * p:.6f}"
    for t, p in zip(TIME, PATH, strict=True)
  ]
  servo = ARM[ARM.index('<position name="elbow"') : ARM.index("</actuator>")]
  wheel = mujoco.MjModel.from_xml_string(ARM.replace(servo, '<velocity joint="elbow" kv="2"/>'))
  (log,) = read_logs([csv_of(tmp_path, lines)], wheel)
  assert log.commands.joints == ("shoulder", "elbow")
  np.testing.assert_allclose(command_of(log, wheel, "shoulder"), 0.5 * PATH, atol=1e-6)
  np.testing.assert_allclose(command_of(log, wheel, "elbow"), 2 * PATH, atol=1e-6)
  with pytest.raises(LogError, match="no column command_position:elbow, which the model's"):
    read_logs([tmp_path / "log.csv"], mujoco.MjModel.from_xml_string(ARM))
  other = [lines[0].replace("position:elbow", "effort:elbow"), *lines[1:]]
  with pytest.raises(LogError, match=r"position of \['shoulder'\] and effort of \['elbow'\]"):
    read_log(csv_of(tmp_path, other))


@pytest.mark.parametrize(
  ("change", "message"),
  [
    (lambda t: t[:1], "has 1 lines, expected a header and readings"),
    (lambda t: [t[0].replace("voltage", "volts"), *t[1:]], "has the column 'volts', expected"),
    (lambda t: [t[0].replace("time", "voltage", 1), *t[1:]], "expected each once and `time`"),
    (lambda t: [t[0].replace("time", "time [min]"), *t[1:]], r"'time \[min\]' in the unit 'min'"),
    (lambda t: [t[0].replace("command_position", "duty"), *t[1:]], "no column command_position"),
    (lambda t: [*t[:9], t[9] + ",4", *t[10:]], "line 10 has 7 fields, the header 6"),
    (lambda t: [*t[:9], t[9].replace(",,,,", ",,x,,"), *t[10:]], "line 10 has 'x' as effort:joint"),
    (lambda t: [*t[:9], t[9].replace(",,,,", ",,nan,,"), *t[10:]], "'nan' as effort:joint"),
    (lambda t: [*t[:9], t[9].replace(",,,,", ",,inf,,"), *t[10:]], "or nothing where none was"),
    (lambda t: [*t[:9], *t[19:21], *t[9:19], *t[21:]], "time runs backwards"),
    (lambda t: t[:40], "lasts 0.18 s with commands and states"),
    (lambda t: [line.replace(",", ";") for line in t], "has ';' between its columns, expected ','"),
    (lambda t: t[1:], r"begins with the numbers \[7.0, 0.0\], expected names in the first line"),
    (
      lambda t: [t[0], *(f"{1e3 * float(r.split(',')[0])},{r.split(',', 1)[1]}" for r in t[1:])],
      r"a reading every 10 s, expected .* such as `time \[ms\]`",
    ),
    (lambda t: [t[0], *(r for i, r in enumerate(t[1:]) if i % 40 < 2)], "at least 20 a second"),
    (
      lambda t: [*t[:2], t[2].replace(f"{PATH[0]:.6f},", ",", 1), *t[3:]],
      "line 3 has some of position, effort and not all",
    ),
  ],
)
def test_a_csv_that_cannot_be_used_is_one_clear_error(change, message, tmp_path):
  with pytest.raises(LogError, match=message) as caught:
    read_log(csv_of(tmp_path, change(rows())))
  assert "\n" not in str(caught.value)


def entries():
  return [
    {
      "timestamp": 3.0 + t,
      "goal_position": 0.5 * p,
      "position": p,
      "speed": 1.0,
      "load": 442.5,
      "input_volts": 7.3,
      "temp": 28,
      "torque_enable": True,
    }
    for t, p in zip(TIME, PATH, strict=True)
  ]


def bam_of(folder, content):
  path = folder / "log.json"
  path.write_text(json.dumps(content))
  return path


def test_a_bam_log(tmp_path):
  path = bam_of(tmp_path, {"motor": "xl330", "kp": 100, "entries": entries()})
  log = read_log(path)
  assert log.joints == (UNNAMED,)
  np.testing.assert_allclose(log.states.stamp, TIME, atol=1e-9)
  np.testing.assert_allclose(log.commands.position[:, 0], 0.5 * PATH)
  assert set(log.pwm.effort.ravel()) == {0.5} and set(log.battery.value) == {7.3}
  (found,) = read_logs([path], mujoco.MjModel.from_xml_string(PENDULUM))
  assert found.joints == found.commands.joints == found.pwm.joints == ("joint",)
  assert list(found.temperatures) == ["joint"]
  with pytest.raises(LogError, match=r"the model drives \['elbow', 'shoulder'\]"):
    named(log, mujoco.MjModel.from_xml_string(ARM))
  assert read_log(bam_of(tmp_path, {"motor": "mx64", "entries": entries()})).pwm is None


@pytest.mark.parametrize(
  ("content", "message"),
  [
    ({"mass": 1.0}, r"has \['mass'\], expected a BAM log with a list of entries"),
    ([1], "has list, expected a BAM log"),
    ({"entries": [{**e, "position": None} for e in entries()]}, "entry 0 has None as 'position'"),
    (
      {"entries": [{**e, "torque_enable": i < 150} for i, e in enumerate(entries())]},
      "torque is off in 50 of 200 entries, first at 1.500 s",
    ),
    ({"entries": entries()[:50]}, "lasts 0.49 s"),
  ],
)
def test_a_json_that_is_no_usable_bam_log_is_one_clear_error(content, message, tmp_path):
  with pytest.raises(LogError, match=message) as caught:
    read_log(bam_of(tmp_path, content))
  assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("seconds", "refused"), [(1.05, True), (2.1, True), (3.0, False)])
def test_a_single_log_is_long_enough_to_leave_a_part_out(seconds, refused):
  log = log_of(PENDULUM, "slow", duration=seconds)
  check_length([log, log], SETTINGS.block_s)
  model = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", [log])
  assert (len(np.unique(JointLikelihood(model).fold)) < 2) == refused
  if not refused:
    check_length([log], SETTINGS.block_s)
    return
  with pytest.raises(LogError, match=r"slow.mcap alone is too short: .* at least 3 s") as caught:
    check_length([log], SETTINGS.block_s)
  assert "\n" not in str(caught.value)


def test_missing_files_and_broken_text(tmp_path):
  with pytest.raises(FileNotFoundError, match=r"no file .*a\.csv"):
    read_log(tmp_path / "a.csv")
  (tmp_path / "b.json").write_text("{")
  with pytest.raises(LogError, match=r"b\.json is not valid JSON"):
    read_log(tmp_path / "b.json")


@pytest.mark.skipif(not list(MEASURED.glob("**/*.json")), reason="Found no BAM log beside this.")
def test_measured_bam_logs():
  for path in MEASURED.glob("**/*.json"):
    log = read_log(path)
    assert log.duration > 1 and np.ptp(log.states.position) > 0.1
