"""Measured logs: what is written comes back, and bad files are refused with one clear line."""

import json
import pathlib

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs import messages, streaming
from nerf2real.core.robot_logs import reading as logs
from nerf2real.core.robot_logs.writer import open_log
from nerf2real.sysid.data.compatibility import check_against_model

START = 1_700_000_000_000_000_000
SAMPLES = pathlib.Path("../shared/data")
PENDULUM = """
  <mujoco><worldbody><body><joint name="elbow" axis="0 1 0"/><geom size=".1" pos="0 0 -.2"/>
  <body><joint name="{second}" type="{type}"/><geom size=".1" pos="0 0 -.4"/></body></body>
  </worldbody><actuator>{actuators}</actuator></mujoco>"""
POSITIONS = '<position joint="elbow" kp="5"/><position joint="wrist" kp="5"/>'


def _write(path, *, duration=2.0, commands=True, joints=("elbow", "wrist"), change=None, lag=0):
  """Writes two joints at 50 Hz commands and 100 Hz states; `change(kind, index, fields)` spoils."""
  change = change or (lambda kind, index, fields: fields)

  def write(topic, kind, index, fields):
    fields = change(kind, index, fields)
    log_ns = fields.pop("log_ns")
    log.write(messages.joint_state(topic=topic, names=joints, **fields), log_ns=log_ns)

  with open_log(path) as log:
    for index in range(round(duration * 100)):
      t = START + index * 10_000_000
      if commands and index % 2 == 0:
        fields = {"time_ns": t, "position": [0.1 * index, -0.5], "log_ns": t + lag}
        write(messages.COMMANDS, "command", index, fields)
      fields = {
        "time_ns": t + 1_000_000,
        "position": [np.sin(index), 2.0],
        "velocity": [np.cos(index), 0.0],
        "effort": [0.25, -0.25],
        "log_ns": t + 1_000_000 + lag,
      }
      write(messages.STATES, "state", index, fields)
  return path


def _spoil(kind, at, **changes):
  return lambda k, index, fields: {**fields, **(changes if (k, index) == (kind, at) else {})}


def test_what_is_written_comes_back(tmp_path):
  path = tmp_path / "log.mcap"
  names = ["elbow", "wrist"]
  with open_log(path) as log:
    for index in range(200):
      t = START + index * 10_000_000
      log.write(messages.joint_state(t, messages.COMMANDS, names, effort=[index, 2.0]))
      state = messages.joint_state(t + 2_000_000, messages.STATES, names, position=[0.5, index])
      log.write(state, log_ns=t + 3_000_000)
      log.write(messages.joint_state(t, messages.PWM, names, effort=[0.1, -1.0]))
      log.write(messages.imu(t, [1, 2, 3], [4, 5, 6], frame="chip"))
      log.write(messages.battery(t, 12.5 if index else np.nan))
      log.write(messages.temperature(t, "wrist", 40.5))
  log = logs.read_log(path)
  assert log.joints == log.commands.joints == ("elbow", "wrist")
  assert log.start_ns == START and not log.recovered
  np.testing.assert_array_equal(log.commands.effort[:, 0], np.arange(200))
  assert log.commands.position is None and log.states.velocity is None
  np.testing.assert_array_equal(log.states.position[:, 1], np.arange(200))
  np.testing.assert_allclose(log.states.stamp, np.arange(200) * 0.01 + 0.002, atol=1e-9)
  np.testing.assert_allclose(log.states.log_time - log.states.stamp, 0.001, atol=1e-9)
  np.testing.assert_array_equal(log.pwm.effort[5], [0.1, -1.0])
  np.testing.assert_array_equal(log.imu.angular_velocity[7], [1, 2, 3])
  np.testing.assert_array_equal(log.imu.linear_acceleration[7], [4, 5, 6])
  assert log.imu.frame == "chip"
  np.testing.assert_array_equal(log.battery.value, np.full(199, 12.5))  # NaN: not measured
  assert list(log.temperatures) == ["wrist"]
  np.testing.assert_array_equal(log.temperatures["wrist"].value, np.full(200, 40.5))


def test_the_file_opens_with_the_ordinary_reader(tmp_path):
  path = _write(tmp_path / "log.mcap")
  with path.open("rb") as stream:
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    messages = list(reader.iter_decoded_messages(topics=[logs.STATES]))
    assert reader.get_header().profile == "ros2"
  schema, _, record, message = messages[3]
  assert schema.name == "sensor_msgs/msg/JointState" and len(messages) == 200
  assert record.log_time == START + 31_000_000 and message.header.stamp.nanosec == 31_000_000
  assert message.name == ["elbow", "wrist"]


def test_columns_follow_names_not_places(tmp_path):
  path = tmp_path / "log.mcap"
  _write(path)
  with open_log(path) as log:
    for index in range(200):
      names = ["wrist", "elbow"] if index % 3 else ["elbow", "wrist"]
      values = [2.0, 1.0] if index % 3 else [1.0, 2.0]
      for topic in (messages.COMMANDS, messages.STATES):
        log.write(messages.joint_state(START + index * 10_000_000, topic, names, position=values))
  log = logs.read_log(path)
  np.testing.assert_array_equal(log.states.position, np.tile([1.0, 2.0], (200, 1)))


@pytest.mark.parametrize(
  ("spoiled", "words"),
  [
    ({"commands": False}, "no commands"),
    ({"duration": 0.1}, "lasts 0.079 s"),
    ({"change": _spoil("state", 40, position=[np.nan, 0.0])}, "NaN or infinite positions"),
    ({"change": _spoil("state", 40, effort=[np.inf, 0.0])}, "NaN or infinite efforts"),
    ({"change": _spoil("command", 40, position=[np.nan, 0.0])}, "first at 0.400 s"),
    ({"change": _spoil("state", 40, time_ns=START)}, "header stamps"),
    ({"change": _spoil("command", 40, log_ns=START)}, "log times"),
    ({"change": _spoil("state", 40, position=[1.0])}, "lengths [1, 2]"),
    ({"change": lambda k, i, f: {**f, "position": []} if k == "command" else f}, "no commands"),
    ({"change": lambda k, i, f: {**f, "position": []} if k == "state" else f}, "no positions"),
    ({"joints": ("elbow", "elbow")}, "unique names"),
    (
      {"change": lambda k, i, f: {**f, "position": [np.nan, 2.0]} if k == "state" else f},
      "positions of ['elbow'] in /joint_states are NaN throughout",
    ),
    (
      {
        "change": lambda k, i, f: (
          {**f, "time_ns": f["time_ns"] + 1_000_000_000_000} if k == "state" else f
        )
      },
      "do not overlap: found commands at 0.000 to 1.980 s and states at 1000.001 to 1001.991 s",
    ),
  ],
)
def test_bad_logs_are_refused_in_one_line(tmp_path, spoiled, words):
  path = _write(tmp_path / "bad.mcap", **spoiled)
  with pytest.raises(logs.LogError) as caught:
    logs.read_log(path)
  assert words in str(caught.value) and "\n" not in str(caught.value)
  assert "bad.mcap" in str(caught.value)


def test_fields_never_measured_are_none(tmp_path):
  """ros2_control reports NaN throughout for what a servo cannot measure."""
  nothing = [np.nan, np.nan]
  path = _write(
    tmp_path / "log.mcap", change=lambda k, i, f: {**f, "effort": nothing} if k == "state" else f
  )
  log = logs.read_log(path)
  assert log.states.effort is None and log.states.velocity is not None


def test_a_field_that_one_joint_lacks_is_read_of_the_others(tmp_path):
  """A controller writes NaN where a joint has no such interface."""
  change = lambda k, i, f: {**f, "effort": [np.nan, 0.5 * i]} if k == "state" else f  # noqa: E731
  path = _write(tmp_path / "log.mcap", change=change)
  effort = logs.read_log(path).states.effort
  assert effort is not None and np.isnan(effort[:, 0]).all()
  np.testing.assert_array_equal(effort[:, 1], 0.5 * np.arange(200))


def test_a_truncated_file_is_refused_and_recovered_when_asked(tmp_path):
  path = _write(tmp_path / "log.mcap", duration=20.0)
  whole = logs.read_log(path)
  content = path.read_bytes()
  path.write_bytes(content[: int(0.6 * len(content))])
  with pytest.raises(logs.LogError, match="truncated or damaged") as caught:
    logs.read_log(path)
  assert "\n" not in str(caught.value)
  part = logs.read_log(path, recover=True)
  count = len(part.states.stamp)
  assert part.recovered and 200 < count < 2000
  np.testing.assert_array_equal(part.states.position, whole.states.position[:count])


def test_a_cut_file_gives_its_messages_in_order(tmp_path):
  path = _write(tmp_path / "log.mcap", duration=20.0)
  whole = list(streaming.read_messages(path))
  assert streaming.is_complete(path) and len(whole) == 3000
  content = path.read_bytes()
  path.write_bytes(content[: int(0.6 * len(content))])
  part = list(streaming.read_messages(path, recover=True))
  assert not streaming.is_complete(path) and 300 < len(part) < 3000
  assert [r[:4] for r in part] == [r[:4] for r in whole[: len(part)]]
  states = list(streaming.read_messages(path, topics=[messages.STATES], recover=True))
  assert [r.stamp_ns for r in states] == [r.stamp_ns for r in part if r.topic == messages.STATES]


def test_definitions_are_those_of_ros():
  """Against rosbags' typestore; ROS's text of BatteryState has constants, too."""
  typesys = pytest.importorskip("rosbags.typesys")
  store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
  kinds = [value for name, value in vars(messages).items() if "/msg/" in str(value)]
  assert len(kinds) == 7
  for kind in kinds:
    text, _ = store.generate_msgdef(kind, ros_version=2)
    wanted = [line for line in text.splitlines() if "=" not in line.strip("=")]
    assert messages.definition(kind).splitlines() == [line for line in wanted if line], kind


def test_another_ros_library_reads_what_is_written(tmp_path):
  typesys = pytest.importorskip("rosbags.typesys")
  store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
  path = tmp_path / "log.mcap"
  lens = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=32.0, cy=24.0, k1=0.1, p2=-0.01)
  with open_log(path) as log:
    log.write(messages.joint_state(START, messages.STATES, ["a", "b"], position=[0.5, -1.25]))
    log.write(messages.imu(START, [1, 2, 3], [4, 5, 6]))
    log.write(messages.gravity(START, [0, 0, -1]))
    log.write(messages.image(START, b"jpeg"))
    log.write(messages.camera_info(START, lens))
    log.write(messages.battery(START, 12.5))
    log.write(messages.temperature(START, "a", 41.0))
  with path.open("rb") as stream:
    found = {
      schema.name: store.deserialize_cdr(message.data, schema.name)
      for schema, _, message in make_reader(stream).iter_messages()
    }
  assert len(found) == 7
  joint, camera = found[messages.JOINT_STATE], found[messages.CAMERA_INFO_TYPE]
  assert joint.name == ["a", "b"] and joint.position.tolist() == [0.5, -1.25]
  assert joint.header.stamp.sec == START // 10**9 and joint.effort.size == 0
  assert found[messages.IMU_TYPE].linear_acceleration.z == 6
  assert found[messages.VECTOR_STAMPED].vector.z == -1
  assert bytes(found[messages.COMPRESSED_IMAGE].data) == b"jpeg"
  assert camera.k[2] == 31.5 and camera.d.tolist() == [0.1, 0, 0, -0.01, 0] and camera.width == 64
  assert found[messages.BATTERY_TYPE].voltage == 12.5 and found[messages.BATTERY_TYPE].present
  assert found[messages.TEMPERATURE_TYPE].header.frame_id == "a"


@pytest.mark.parametrize("cut", [0, 3, 8, 20])
def test_a_file_cut_at_its_start_is_refused(tmp_path, cut):
  path = _write(tmp_path / "log.mcap")
  path.write_bytes(path.read_bytes()[:cut])
  with pytest.raises(logs.LogError) as caught:
    logs.read_log(path)
  assert "\n" not in str(caught.value)


def test_a_flipped_byte_is_refused(tmp_path):
  path = _write(tmp_path / "log.mcap")
  content = bytearray(path.read_bytes())
  content[len(content) // 3] ^= 0xFF
  path.write_bytes(content)
  with pytest.raises(logs.LogError, match="truncated or damaged"):
    logs.read_log(path)


def test_other_files_are_refused(tmp_path):
  path = tmp_path / "log.mcap"
  path.write_text("time,position\n0,1\n")
  with pytest.raises(logs.LogError, match="is not an MCAP file"):
    logs.read_log(path)
  with pytest.raises(FileNotFoundError, match=r"nowhere\.mcap"):
    logs.read_log(tmp_path / "nowhere.mcap")


@pytest.mark.parametrize(
  ("second", "joint_type", "actuators", "words"),
  [
    ("wrist", "slide", POSITIONS, None),
    ("knee", "hinge", '<position joint="elbow" kp="5"/>', "['wrist'] that the model lacks"),
    ("wrist", "ball", '<position joint="elbow" kp="5"/>', "neither a hinge nor a slide"),
    ("wrist", "hinge", '<position joint="elbow" kp="5"/>', "no actuator"),
    ("wrist", "hinge", '<motor joint="wrist"/><position joint="elbow" kp="5"/>', "no efforts"),
    ("wrist", "hinge", POSITIONS + '<motor name="m" joint="wrist"/>', "['number 1', 'm']"),
    ("wrist", "hinge", '<velocity joint="wrist"/><position joint="elbow"/>', "record velocities"),
  ],
)
def test_models_that_do_not_fit_are_refused(tmp_path, second, joint_type, actuators, words):
  log = logs.read_log(_write(tmp_path / "log.mcap"))
  xml = PENDULUM.format(second=second, type=joint_type, actuators=actuators)
  model = mujoco.MjModel.from_xml_string(xml)
  if words is None:
    check_against_model(log, model)
    return
  with pytest.raises(logs.LogError) as caught:
    check_against_model(log, model)
  assert words in str(caught.value) and "\n" not in str(caught.value)


# Logs of every sample: motions from which a model is fitted, held-out ones, and references.
_TRAINED = ("train_1_sweep", "train_2_slow", "train_3_steps")
_MUJOCO_SAMPLE = (
  "held_1_multisine",
  "held_2_sweep",
  "train_1_sweep",
  "train_2_slow",
  "train_3_steps",
)
_SERVO_SAMPLE = (
  *("held_1", "held_2", "reference_1_sweep", "reference_2_slow", "reference_3_steps"),
  *_TRAINED,
)
_SHARED = {
  "sysid_samples": dict.fromkeys(
    ("s1_null", "s2_delay", "s3_viscous", "s4_payload"), _MUJOCO_SAMPLE
  ),
  "sysid_samples_2": {
    **dict.fromkeys(
      ("a_healthy", "b_delay", "c_stribeck", "d_payload", "e_outside"), _SERVO_SAMPLE
    ),
    "f_payload_and_late_bus": _MUJOCO_SAMPLE,
  },
  "measured": {
    "emps": ("held_1", "train_1"),
    **dict.fromkeys(
      ("xl330_kp100", "xl330_kp200", "xl330_kp800"),
      ("held_sin_sin", "train_sin_time_square", "train_up_and_down"),
    ),
  },
}


@pytest.mark.skipif(not SAMPLES.is_dir(), reason=f"needs the shared samples in {SAMPLES}")
@pytest.mark.parametrize("folder", _SHARED)
def test_the_shared_samples_are_read(folder):
  found: dict[str, tuple[str, ...]] = {}
  for path in sorted((SAMPLES / folder).glob("*/*.mcap")):
    found[path.parent.name] = (*found.get(path.parent.name, ()), path.stem)
  assert found == _SHARED[folder]
  answers = SAMPLES / folder / "answers.json"
  if answers.exists():
    assert set(json.loads(answers.read_text())) == set(found)
  for sample, names in found.items():  # one log of each: reading all takes a minute
    path = SAMPLES / folder / sample / f"{names[-1]}.mcap"
    log = logs.read_log(path)
    check_against_model(log, mujoco.MjModel.from_xml_path(str(path.parent / "model.xml")))
    assert log.duration > 5 and np.ptp(log.states.position) > 0
