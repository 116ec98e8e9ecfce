"""What happens to the link when processes die, freeze, lie or may not join.

The learner is a process without networks (`mini_learner.py`), so that each case takes seconds; the
same cases with the whole agent are in `tests/agents/processes/test_runs.py`.
"""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from nerf2real.agents.dmpo.replay.ring import Replay
from nerf2real.agents.link import client, schema, sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink, actor_key
from nerf2real.agents.supervision.training import free_port
from tests.agents.link import mini_learner

ROOT = Path(__file__).resolve().parents[3]


def _environment():
  return os.environ | {"PYTHONPATH": str(ROOT)}


class Learner:
  """Starts, kills and freezes the mini learner."""

  def __init__(self, folder, *, lease=10.0, users=None, router=None):
    self.endpoint = router or f"tcp/127.0.0.1:{free_port()}"
    self._folder, self._lease, self._users = folder, lease, users
    self._joins = router is not None
    self.start()

  def start(self):
    command = [
      sys.executable,
      mini_learner.__file__,
      self.endpoint,
      str(self._folder),
      str(self._lease),
      *([str(self._users)] if self._users else []),
      *(["join"] if self._joins else []),
    ]
    self.process = subprocess.Popen(command, stdout=subprocess.PIPE, env=_environment(), text=True)
    assert self.process.stdout.readline() == "ready\n"

  def kill(self):
    self.process.kill()
    self.process.wait()

  def freeze(self, seconds):
    self.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    self.process.send_signal(signal.SIGCONT)


@pytest.fixture
def learner(request, tmp_path):
  started = Learner(tmp_path / "replay", **getattr(request, "param", {}))
  yield started
  if started.process.poll() is None:
    started.kill()


def _join(learner, name="actor-1", *, lease=10.0, login=None, **arguments):
  settings = sessions.LinkSettings(lease=lease, security=sessions.Security(login=login))
  session = sessions.connect(learner.endpoint, settings, timeout=30)
  return client.ActorLink(session, settings, actor=name, **arguments)


def _act(link, count, *, timeout=60.0, pause=0.0):
  """Makes `count` trajectories, each paid for by credits."""
  deadline = time.monotonic() + timeout
  credits = made = 0
  while made < count:
    assert time.monotonic() < deadline, "The link stands still."
    while not credits and time.monotonic() < deadline:
      link.flush()
      grant = link.request(mini_learner.LENGTH - 1)
      credits = grant["granted"] if grant else 0
      if not credits:
        time.sleep(0.01)
    link.send(mini_learner.make_trajectory(link.outbox.made + 1), steps=mini_learner.LENGTH - 1)
    credits, made = 0, made + 1
    time.sleep(pause)


def _stored(learner, tmp_path):
  """(actor, number) to the reward stored, read from the files as they are."""
  replay = Replay(
    mini_learner.FIELDS,
    length=mini_learner.LENGTH,
    capacity_steps=1000 * (mini_learner.LENGTH - 1),
    folder=tmp_path / "replay",
  )
  origins = replay.origins()
  assert len(origins) == len(set(origins)), "A trajectory was inserted twice."
  return origins


def test_all_arrive_once_and_updates_follow_the_steps(learner, tmp_path):
  links = [_join(learner, f"actor-{i}") for i in range(2)]
  for _ in range(20):
    for link in links:
      _act(link, 1)
  assert all(link.drain(timeout=60) for link in links)
  status = links[0].status()["status"]
  assert status["steps"] == 2 * 20 * 47
  assert abs(status["updates"] * 8 / status["steps"] - 1) < 0.01
  assert status["dropped"] == status["gaps"] == status["refused"] == 0
  assert sorted(_stored(learner, tmp_path)) == sorted(
    (actor_key(f"actor-{i}"), n) for i in range(2) for n in range(1, 21)
  )
  assert links[0].parameters()[0] == 1
  np.testing.assert_array_equal(links[0].parameters()[1]["w"], [7, 7, 7])


def test_kill_9_of_the_learner_loses_and_repeats_nothing(learner, tmp_path):
  link = _join(learner, resend_after=1.0, ask_timeout=0.5)
  _act(link, 10)
  learner.kill()
  link.send(
    mini_learner.make_trajectory(link.outbox.made + 1), steps=mini_learner.LENGTH - 1
  )  # nobody is there
  assert link.request(1) is None
  assert link.outbox.size > 0
  learner.start()
  _act(link, 10)
  assert link.drain(timeout=60)
  assert sorted(n for _, n in _stored(learner, tmp_path)) == list(range(1, 22))


@pytest.mark.parametrize("learner", [{"lease": 1.0}], indirect=True)
def test_a_frozen_learner_loses_nothing(learner, tmp_path):
  """Frozen for three leases: the transport is closed meanwhile."""
  link = _join(learner, lease=1.0, resend_after=1.0, ask_timeout=0.5)
  _freeze_while_acting(learner, link, tmp_path, 3.0)


@pytest.mark.slow
def test_a_learner_frozen_for_20_seconds_loses_nothing(learner, tmp_path):
  link = _join(learner)
  _freeze_while_acting(learner, link, tmp_path, 20.0)


def _freeze_while_acting(learner, link, tmp_path, seconds):
  _act(link, 5)
  learner.process.send_signal(signal.SIGSTOP)
  # Without asking: what is put while the learner is frozen must not vanish either.
  for _ in range(3):
    link.send(mini_learner.make_trajectory(link.outbox.made + 1), steps=mini_learner.LENGTH - 1)
  time.sleep(seconds)
  learner.process.send_signal(signal.SIGCONT)
  _act(link, 5)
  assert link.drain(timeout=60)
  assert sorted(n for _, n in _stored(learner, tmp_path)) == list(range(1, 14))
  assert link.status()["status"]["dropped"] == 0


def test_kill_9_of_an_actor_returns_its_credits(learner, tmp_path):
  code = (
    "import time; from tests.agents.link import test_faults as t, mini_learner as m\n"
    f"class L: endpoint = {learner.endpoint!r}\n"
    "link = t._join(L, 'victim', lease=60.0); t._act(link, 3); assert link.drain(timeout=60)\n"
    "link.request(47); print('acting', flush=True); time.sleep(60)\n"
  )
  victim = subprocess.Popen(
    [sys.executable, "-c", code], stdout=subprocess.PIPE, env=_environment(), cwd=ROOT, text=True
  )
  assert victim.stdout.readline() == "acting\n"
  link = _join(learner, "other")
  before = link.status()["status"]
  assert before["alive"].count("victim") == 1 and before["outstanding"] == 47
  victim.kill()
  victim.wait()
  deadline = time.monotonic() + 30  # half the lease: the closed connection tells
  while "victim" in (status := link.status()["status"])["alive"]:
    assert time.monotonic() < deadline, "The death was not noticed."
    time.sleep(0.02)
  assert status["outstanding"] == 0
  assert sorted(n for _, n in _stored(learner, tmp_path)) == [1, 2, 3]  # acknowledged: kept


def test_malformed_messages_are_refused_and_counted(learner):
  link = _join(learner)
  while not link.learner_is_there:
    time.sleep(0.01)
  good = mini_learner.make_trajectory(1)
  values = {"actor": "broken", "number": 1, "steps": 47}
  bad = [
    b"rubbish",
    schema.encode("metrics", values, good),
    schema.encode("trajectory", {"actor": "broken", "steps": 47}, good),
    schema.encode("trajectory", {"actor": "broken", "number": 1}, good),
    schema.encode("trajectory", values | {"number": -1}, good),
    schema.encode("trajectory", values, {"reward": good["reward"]}),
    schema.encode("trajectory", values | {"number": 2}, {"image": good["image"]}),
    schema.encode("trajectory", values | {"number": 3}, good | {"reward": np.float32(1)}),
    schema.encode("trajectory", values | {"number": 4}, good | {"image": good["image"][:, :5]}),
  ]
  for data in bad:
    link._publisher.put(data)
  with pytest.raises(schema.MessageError, match="whole number"):
    link.ask("credit", schema.encode("credit", {"actor": "a", "wanted": -1}), kind="grant")
  _act(link, 2)  # goes on
  assert link.drain(timeout=60)
  deadline = time.monotonic() + 60
  while (status := link.status()["status"])["refused"] < len(bad) + 1:
    assert time.monotonic() < deadline, status
    time.sleep(0.02)
  assert status["refused"] == len(bad) + 1
  assert status["trajectories"] == 2


def test_a_refused_trajectory_is_acknowledged_and_what_follows_arrives(learner, tmp_path):
  """A NaN in one trajectory must not hold up its actor: credits return, the rest is taken."""
  link = _join(learner, "sick", resend_after=0.5)
  assert link.request(47)["granted"] == 47
  bad = mini_learner.make_trajectory(1)
  bad["reward"][3] = np.nan
  link.send(bad, steps=47)
  assert link.drain(timeout=60)
  assert link.request(0)["granted"] == 0  # says what is held: nothing any more
  status = link.status()["status"]
  assert (status["refused"], status["outstanding"]) == (1, 0)
  assert status["refused_by"] == {"sick": 1}
  assert "trajectory 1 of sick: reward holds numbers that are not finite" in status["last_refusal"]
  _act(link, 10)  # many more than the credits of one trajectory
  assert link.drain(timeout=60)
  status = link.status()["status"]
  assert (status["steps"], status["refused"], status["gaps"]) == (10 * 47, 1, 0)
  assert sorted(n for _, n in _stored(learner, tmp_path)) == list(range(2, 12))


def test_figures_that_are_not_finite_are_null_and_end_no_actor():
  """An environment's NaN is in its return, too."""
  sent = []
  session = mock.Mock()
  session.declare_publisher.return_value.put = sent.append
  link = client.ActorLink(session, sessions.LinkSettings(), actor="sick")
  link.report({"return": float("nan"), "low": -np.inf, "length": 3, "success": True})
  values = schema.decode(sent[0], kind="metrics").values
  assert values == {"who": "sick", "return": None, "low": None, "length": 3, "success": True}


def test_a_failing_replay_is_reported_and_ends_the_taking_in(tmp_path):
  """Such as on a full disk: whoever runs the learner sees it, and nothing is acknowledged."""
  endpoint = f"tcp/127.0.0.1:{free_port()}"

  def insert(trajectory, actor, number):
    raise OSError(28, "No space left on device")

  settings = sessions.LinkSettings()
  limiter = RateLimiter(
    LimiterSettings(steps_per_update=8.0, min_replay_steps=1, trajectory_steps=47)
  )
  session = sessions.listen(endpoint, settings)
  served = LearnerLink(session, settings, limiter=limiter, insert=insert, description={})
  client_session = sessions.connect(endpoint, settings, timeout=30)
  link = client.ActorLink(client_session, settings, actor="actor-0-a")
  try:
    while not link.learner_is_there:
      time.sleep(0.01)
    assert not served.failure
    link.send(mini_learner.make_trajectory(1), steps=47)
    deadline = time.monotonic() + 60
    while not served.failure:
      assert time.monotonic() < deadline, "The failure was not noticed."
      time.sleep(0.01)
    assert "No space left on device" in served.failure
    assert link.request(0)["acknowledged"] == 0 and link.outbox.size == 1
  finally:
    link.close()
    served.close()
    sessions.close(session)


@pytest.fixture
def users(tmp_path):
  path = tmp_path / "users.txt"
  path.write_text("learner:one\nactor:two\n")
  return path


def _login(tmp_path, text):
  path = tmp_path / f"login-{abs(hash(text))}.txt"
  path.write_text(text)
  return path


def test_only_users_with_their_password_join(tmp_path, users):
  learner = Learner(tmp_path / "replay", users=users)
  try:
    for login in ("actor:wrong", "nobody:two", None):
      with pytest.raises(sessions.LinkError, match="refused the user or the password"):
        settings = sessions.LinkSettings(
          security=sessions.Security(login=_login(tmp_path, login) if login else None)
        )
        sessions.connect(learner.endpoint, settings, timeout=0)
    link = _join(learner, login=_login(tmp_path, "actor:two"))
    _act(link, 2)
    assert link.drain(timeout=60)

    # A user may not take the learner's part: neither answer in its place nor publish as it.
    other = _join(learner, "other", login=_login(tmp_path, "actor:two"))
    heard = []
    other._session.declare_queryable("nerf2real/ask/credit", lambda q: heard.append(q))
    other._session.declare_subscriber("nerf2real/trajectory/*", lambda s: heard.append(s))
    time.sleep(0.3)
    _act(link, 3)
    assert link.drain(timeout=60)
    assert heard == []
  finally:
    learner.kill()


def test_beyond_this_machine_only_with_users():
  with pytest.raises(sessions.LinkError, match="no users are set"):
    sessions.listen("tcp/0.0.0.0:0", sessions.LinkSettings())
  with pytest.raises(sessions.LinkError, match="certificate"):
    sessions.listen("tls/127.0.0.1:0", sessions.LinkSettings())
  for kind in (sessions.listen, functools.partial(sessions.connect, timeout=0.0)):
    with pytest.raises(sessions.LinkError, match="'127.0.0.1' is no endpoint"):
      kind("127.0.0.1", sessions.LinkSettings(security=sessions.Security(allow_anonymous=True)))
  assert sessions.is_loopback("tcp/127.0.0.1:7447") and sessions.is_loopback("tcp/[::1]:7447")
  assert not sessions.is_loopback("tcp/[::]:7447") and not sessions.is_loopback("tcp/10.0.0.1:1")


def test_nothing_else_listens_and_nothing_is_scouted(learner):
  """The learner has one listening socket, on the loopback, and no UDP socket."""
  if not Path("/proc/net/tcp").exists():
    pytest.skip("needs /proc")
  folder = Path(f"/proc/{learner.process.pid}/fd")
  inodes = {os.readlink(fd).removeprefix("socket:[").rstrip("]") for fd in folder.iterdir()}
  listening, udp = [], []
  for name in ("tcp", "tcp6", "udp", "udp6"):
    for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
      fields = line.split()
      if fields[9] in inodes:
        if name.startswith("udp"):
          udp.append(fields[1])
        elif fields[3] == "0A":
          listening.append(fields[1].partition(":")[0])
  assert listening == ["0100007F"] and udp == []


def test_tls(tmp_path):
  key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
  command = [
    "openssl",
    "req",
    "-x509",
    "-newkey",
    "ec",
    "-pkeyopt",
    "ec_paramgen_curve:P-256",
    "-nodes",
    "-days",
    "2",
    "-subj",
    "/CN=localhost",
    "-addext",
    "subjectAltName=DNS:localhost",
    "-addext",
    "basicConstraints=critical,CA:FALSE",
    "-keyout",
    key,
    "-out",
    certificate,
  ]
  try:
    subprocess.run(command, check=True, capture_output=True)
  except (OSError, subprocess.CalledProcessError) as error:
    pytest.skip(f"needs openssl to make a certificate: {error}")
  endpoint = f"tls/localhost:{free_port()}"
  session = sessions.listen(
    endpoint,
    sessions.LinkSettings(security=sessions.Security(tls_certificate=certificate, tls_key=key)),
  )
  trusted = sessions.LinkSettings(security=sessions.Security(tls_authority=certificate))
  with sessions.connect(endpoint, trusted, timeout=30) as other:
    got = []
    session.declare_subscriber("a", lambda sample: got.append(sample.payload.to_bytes()))
    deadline = time.monotonic() + 60
    while not got and time.monotonic() < deadline:
      other.put("a", b"secret")
      time.sleep(0.05)
    assert got
  with pytest.raises(sessions.LinkError):
    sessions.connect(endpoint, sessions.LinkSettings(), timeout=0)
  session.close()
