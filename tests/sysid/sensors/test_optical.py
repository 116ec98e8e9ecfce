"""The camera's effects against pictures that OpenCV drew of a room, by equations of the test's."""

import json

import cv2
import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from nerf2real import sysid
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.suite.effects import EffectStack, read_effects
from nerf2real.sysid.sensors import brightness, optical, pictures, sensing, tracks, viewpoint
from tests.sysid import film
from tests.sysid.film import Film

SHORT = 4.0  # s


@pytest.fixture(scope="module")
def model():
  return mujoco.MjModel.from_xml_string(film.MODEL)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
  """A healthy camera in the same room, moved otherwise."""
  return film.record(tmp_path_factory.mktemp("r") / "r.mcap", Film(duration=SHORT), seed=9)


def _named(part):
  return {r["kind"]: next(iter(r["parameters"].values())) for r in part.rows}


@pytest.mark.parametrize(
  ("truth", "seed"),
  [
    (Film(late=0.04, duration=SHORT), 1),
    (Film(late=0.025, scale=1.12, duration=SHORT), 2),
    (Film(scale=0.9, mount=(0.02, -0.02, 0.03), duration=SHORT), 3),
  ],
  ids=["late", "late_and_long", "short_on_a_crooked_mount"],
)
def test_latency_and_focal_length_are_found(model, truth, seed, tmp_path):
  seen = optical.find(model, [film.record(tmp_path / "a.mcap", truth, seed=seed)])
  found = _named(seen.part)
  expected = {}
  if truth.late:
    expected["camera_latency"] = truth.late - 0.001  # the joints are 1 ms late themselves
  if truth.scale != 1:
    expected["camera_focal"] = truth.scale
  assert set(found) == set(expected)
  for kind, true in expected.items():
    assert found[kind]["low"] <= true <= found[kind]["high"]
    assert found[kind]["value"] == pytest.approx(true, rel=0.03 if kind == "camera_focal" else 0.06)
  assert seen.part.after < 0.8 * seen.part.before
  assert not seen.part.alternatives


def test_a_healthy_camera_is_not_accused(model, tmp_path):
  """A mount, stamps that jitter, distances: 2 here, 24 more in `test_healthy_cameras`."""
  for seed in range(2):
    truth = Film(jitter=0.004, mount=(0.02, 0.01, -0.02), duration=SHORT, place=seed % 2)
    part = optical.find(model, [film.record(tmp_path / "a.mcap", truth, seed=seed)]).part
    assert part.rows == [] and part.alternatives == [], seed


@pytest.mark.slow
def test_healthy_cameras(model, tmp_path):
  """At most 1 of 24 is accused."""
  accused = 0
  for seed in range(24):
    rng = np.random.default_rng([seed, 31])
    truth = Film(
      jitter=rng.uniform(0, 0.005),
      mount=tuple(rng.normal(0, 0.02, 3)),
      motion=str(rng.choice(["both", "both", "pan"])),
      place=seed % 3,
    )
    part = optical.find(model, [film.record(tmp_path / "a.mcap", truth, seed=seed)]).part
    accused += bool(part.rows or part.alternatives)
  assert accused <= 1


def test_a_camera_that_stands_still_shows_nothing(model, tmp_path):
  truth = Film(late=0.05, motion="still", duration=3.0)
  part = optical.find(model, [film.record(tmp_path / "a.mcap", truth)]).part
  assert part.rows == [] and part.alternatives == []
  assert "does not turn" in part.notes[0]


def test_a_log_without_pictures_is_not_opened_twice(model, tmp_path, monkeypatch):
  log = film.record(tmp_path / "a.mcap", Film(duration=3.0), pictures=False)
  for name in ("_messages", "source", "read"):
    monkeypatch.setattr(pictures, name, None)
  assert optical.find(model, [log]) is None
  assert sensing.find(model, [log]).parts == {}


@pytest.mark.parametrize(
  ("change", "lens", "words"),
  [
    (lambda s: s, False, "no lens"),
    (
      lambda s: s.replace('name="camera"', 'name="eye"').replace(
        "</body></body>", '</body></body><camera name="wall"/>'
      ),
      True,
      "name the model's camera",
    ),
    (
      lambda s: s.replace(
        '<worldbody><body pos="0 0 0.4">',
        '<worldbody><body pos="0 0 0.4"><joint name="slide" type="slide"/>',
      ),
      True,
      "slide",
    ),
  ],
  ids=["lens", "camera", "joint"],
)
def test_pictures_that_cannot_be_used_are_skipped_in_one_line(change, lens, words, tmp_path):
  log = film.record(tmp_path / "a.mcap", Film(duration=1.5), lens=lens)
  seen = optical.find(mujoco.MjModel.from_xml_string(change(film.MODEL)), [log])
  (note,) = seen.part.notes
  assert words in note and "\n" not in note and seen.part.rows == []


def test_the_only_camera_is_taken_whatever_its_name():
  only = mujoco.MjModel.from_xml_string(film.MODEL.replace('name="camera"', 'name="eye"'))
  assert viewpoint.choose(only, "camera") == 0


def test_the_lens_is_read_as_it_was_written_and_pictures_are_decoded_small(tmp_path):
  log = film.record(tmp_path / "a.mcap", Film(duration=1.5))
  source = pictures.source(log.path, log.start_ns)
  assert source.lens == film.LENS and source.frame == "camera"
  assert log.pictures == 26
  frames = list(pictures.read(source))
  assert len(frames) == 26 and frames[0][1].shape == (240, 320)
  assert frames[0][0] == pytest.approx(0.1, abs=0.01)


def test_pictures_of_a_file_without_an_index_are_found_too(tmp_path):
  log = film.record(tmp_path / "a.mcap", Film(duration=1.5))
  with log.path.open("rb") as stream, (tmp_path / "b.mcap").open("wb") as target:
    writer = Writer(
      target,
      use_statistics=False,
      use_summary_offsets=False,
      repeat_channels=False,
      repeat_schemas=False,
      use_chunking=False,
      index_types=IndexType.NONE,
    )
    writer.start()
    known = {}
    for schema, channel, message in make_reader(stream).iter_messages():
      if channel.id not in known:
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
      writer.add_message(
        known[channel.id], message.log_time, message.data, message.publish_time, message.sequence
      )
    writer.finish()
  assert read_log(tmp_path / "b.mcap").pictures == 26
  again = pictures.source(tmp_path / "b.mcap", log.start_ns)
  assert len(list(pictures.read(again))) == 26


def test_tracks_follow_a_picture_that_shifts(tmp_path):
  """A wall that moves by 3.25 pixels: interpolated by the test."""
  rng = np.random.default_rng(5)
  wall = cv2.GaussianBlur(rng.uniform(0, 255, (240, 400)).astype(np.float32), (0, 0), 2.0)
  wall = np.clip((wall - wall.mean()) * 6 + 128, 0, 255)
  later = cv2.warpAffine(wall, np.array([[1, 0, 3.25], [0, 1, -1.5]]), (400, 240))
  start, end = tracks._tracks(wall[:, :320].astype(np.uint8), later[:, :320].astype(np.uint8))
  assert len(start) > 10
  assert np.median(end - start, axis=0) == pytest.approx([3.25, -1.5], abs=0.05)


@pytest.mark.parametrize(("gain", "late"), [(1.4, 0.0), (0.5, 0.04), (1.0, 0.0)])
def test_gain_is_found_beside_reference_logs(gain, late, reference, tmp_path):
  model = mujoco.MjModel.from_xml_string(film.MODEL.replace('name="camera"', 'name="eye"'))
  log = film.record(tmp_path / "a.mcap", Film(gain=gain, late=late, duration=SHORT), seed=1)
  seen = optical.Seen(optical.Part(), *optical.look(model, [log]), late)
  part = brightness.find(model, seen, [reference])
  if gain == 1:
    assert part.rows == []
  else:
    assert _named(part)["camera_gain"]["value"] == pytest.approx(gain, rel=0.03)
    assert [row["sensor"] for row in part.rows] == ["eye"]
    assert _named(part)["camera_gain"]["low"] < gain < _named(part)["camera_gain"]["high"]


def test_another_place_says_nothing_of_the_gain(model, reference, tmp_path):
  log = film.record(tmp_path / "a.mcap", Film(gain=0.5, place=3, duration=3.0))
  part = brightness.find(
    model, optical.Seen(optical.Part(), *optical.look(model, [log])), [reference]
  )
  assert part.rows == [] and "do not show" in part.notes[0]


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
  """Two logs of a late, long, bright camera, identified from files to files."""
  folder = tmp_path_factory.mktemp("film")
  (folder / "model.xml").write_text(film.MODEL)
  truth = Film(late=0.045, scale=1.1, gain=1.3, duration=SHORT)
  for seed in (1, 2):
    film.record(folder / f"{seed}.mcap", truth, seed=seed)
  film.record(folder / "reference.mcap", Film(duration=SHORT), seed=3)
  content = sysid.identify(
    folder / "model.xml",
    [folder / "1.mcap", folder / "2.mcap"],
    reference=[folder / "reference.mcap"],
    out=folder / "out",
  )
  return folder, content


@pytest.mark.slow
def test_from_files_to_files(identified):
  folder, content = identified
  rows = {e["kind"]: e for e in content["effects"] if e["kind"].startswith("camera_")}
  assert set(rows) == {"camera_latency", "camera_focal", "camera_gain"}
  assert rows["camera_latency"]["sensor"] == "camera"
  assert rows["camera_latency"]["parameters"]["delay"]["value"] == pytest.approx(0.044, abs=0.002)
  assert json.loads((folder / "out" / "report.json").read_text()) == content
  effects = [e for e in read_effects(folder / "out" / "effects.json") if "camera" in e.kind]
  stack = EffectStack(effects).bind(mujoco.MjModel.from_xml_string(film.MODEL))
  stack.reset()
  grey = np.full((30, 40, 3), 100, np.uint8)
  stack.observe("camera", grey // 2, 0.0)
  assert stack.observe("camera", grey, 0.025).max() == pytest.approx(65, abs=2)  # late, brighter
  page = (folder / "out" / "report.html").read_text()
  assert "camera_latency" in page and "camera_gain" in page
  details = json.loads((folder / "out" / "details.json").read_text())
  assert details["sensors"]["camera"]["after"] < details["sensors"]["camera"]["before"]


def test_reading_a_log_keeps_no_pictures(tmp_path):
  log = film.record(tmp_path / "a.mcap", Film(duration=1.5))
  again = read_log(log.path)
  assert again.path == log.path and again.imu is None
