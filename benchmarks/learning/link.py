"""The link beside raw zenoh, with a stalled receiver: `python benchmarks/learning/link.py`.

Sends 48-step trajectories with 30x40 pictures (173 KB) from one process to another; in the middle
the receiver is stopped for 20 s (SIGSTOP), as a long compilation or a checkpoint on a starved
machine would. Counted: messages lost and repeated, MB/s and messages/s before it. "zenoh"
is a plain put with congestion control BLOCK and default settings, "link" this project's.
"""

import dataclasses
import json
import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import zenoh

from benchmarks import harness
from nerf2real.agents.link import client, sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink
from nerf2real.agents.supervision.training import free_port

STEPS = 48


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to send."""

  messages: int = 4000
  """Trajectories of each."""
  stall: float = 20.0
  """How long the receiver is stopped [s]."""


_QUIET = 3.0  # s without a message after which the receiver has all that will come


def make_trajectory(number: int) -> dict[str, np.ndarray]:
  """A trajectory of 173 KB that carries its number."""
  return {
    "image": np.zeros((STEPS, 30, 40, 3), np.uint8),
    "reward": np.full(STEPS, number, np.float32),
  }


class _Count:
  """Numbers that arrived, when (the machine's monotonic clock), and how many, for the sender."""

  def __init__(self, arrived: Any) -> None:
    self.numbers: list[int] = []
    self.times: list[float] = []
    self._arrived = arrived

  def add(self, number: int) -> None:
    self.numbers.append(number)
    self.times.append(time.monotonic())
    self._arrived.value = len(self.numbers)


def _report(count: _Count, pipe: Connection) -> None:
  pipe.recv()  # the sender is done
  done = time.monotonic()
  while time.monotonic() - max([done, *count.times[-1:]]) < _QUIET:
    time.sleep(0.1)
  pipe.send((count.numbers, count.times))


def receive_link(endpoint: str, pipe: Connection, arrived: Any) -> None:
  """The receiver with this project's link."""
  settings, count = sessions.LinkSettings(), _Count(arrived)
  limiter = RateLimiter(
    LimiterSettings(steps_per_update=1e9, min_replay_steps=10**9, trajectory_steps=STEPS - 1)
  )

  def insert(trajectory: Any, actor: int, number: int) -> int:
    count.add(int(trajectory["reward"][0]))
    return STEPS - 1

  session = sessions.listen(endpoint, settings)
  link = LearnerLink(session, settings, limiter=limiter, insert=insert, description={})
  pipe.send("ready")
  _report(count, pipe)
  link.close()
  session.close()


def receive_raw(endpoint: str, pipe: Connection, arrived: Any) -> None:
  """The receiver with a plain subscriber."""
  count = _Count(arrived)
  session = zenoh.open(_raw_config("peer", "listen", endpoint))

  def take(sample: zenoh.Sample) -> None:
    data = sample.payload.to_bytes()
    count.add(int(np.frombuffer(data, np.float32, 1)[0]))

  subscriber = session.declare_subscriber("trajectory", take)
  pipe.send("ready")
  _report(count, pipe)
  subscriber.undeclare()
  session.close()


def _raw_config(mode: str, side: str, endpoint: str) -> zenoh.Config:
  config = zenoh.Config()
  config.insert_json5("mode", json.dumps(mode))
  config.insert_json5("scouting/multicast/enabled", "false")
  config.insert_json5(f"{side}/endpoints", json.dumps([endpoint]))
  return config


def send_link(endpoint: str, messages: int, half: Any) -> None:
  """Sends with this project's link: credits, numbers, acknowledgements."""
  settings = sessions.LinkSettings()
  session = sessions.connect(endpoint, settings, timeout=10)
  link = client.ActorLink(session, settings, actor="benchmark")
  for number in range(messages):
    if number == messages // 2:
      half()
    while True:
      link.flush()
      grant = link.request(STEPS - 1)
      if grant is not None and grant["granted"]:
        break
    link.send(make_trajectory(number), steps=STEPS - 1)
  link.drain(timeout=60)
  link.close()


def send_raw(endpoint: str, messages: int, half: Any) -> None:
  """Sends with plain puts."""
  session = zenoh.open(_raw_config("client", "connect", endpoint))
  publisher = session.declare_publisher(
    "trajectory", congestion_control=zenoh.CongestionControl.BLOCK
  )
  # A put before that reaches nobody. The stubs call the status a bool.
  while not publisher.matching_status.matching:  # type: ignore[attr-defined]
    time.sleep(0.01)
  for number in range(messages):
    if number == messages // 2:
      half()
    trajectory = make_trajectory(number)
    publisher.put(trajectory["reward"].tobytes() + trajectory["image"].tobytes())
  sessions.close(session)


def run(name: str, messages: int, stall: float) -> dict[str, harness.Value]:
  """Runs one of the two; rates are those of the first half, which has arrived when it stalls."""
  receive, send = {"zenoh": (receive_raw, send_raw), "link": (receive_link, send_link)}[name]
  endpoint = f"tcp/127.0.0.1:{free_port()}"
  context = multiprocessing.get_context("spawn")
  ours, theirs = context.Pipe()
  arrived = context.Value("q", 0)
  receiver = context.Process(target=receive, args=(endpoint, theirs, arrived), daemon=True)
  receiver.start()
  assert ours.recv() == "ready"
  pid = receiver.pid or 0
  waker = None
  stopped = float("inf")

  def half() -> None:
    nonlocal waker, stopped
    _settle(arrived, messages // 2)
    if stall:
      stopped = time.monotonic()
      os.kill(pid, signal.SIGSTOP)
      waker = context.Process(target=_wake, args=(pid, stall))
      waker.start()

  send(endpoint, messages, half)
  if waker is not None:
    waker.join()
  ours.send("done")
  numbers, times = ours.recv()
  receiver.join(timeout=10)
  before = [t for t in times if t < stopped]
  rate = (len(before) - 1) / (before[-1] - before[0]) if len(before) > 1 else 0.0
  size = sum(a.nbytes for a in make_trajectory(0).values())
  return {
    "stall_s": stall,
    "lost": harness.Rate(messages - len(set(numbers)), messages),
    "repeated": len(numbers) - len(set(numbers)),
    "messages_per_s": rate,
    "mb_per_s": rate * size / 1e6,
  }


def _settle(arrived: Any, expected: int) -> None:
  """Waits until `expected` messages have arrived, or none came for a while."""
  seen, since = -1, time.monotonic()
  while arrived.value < expected and time.monotonic() - since < _QUIET:
    if arrived.value != seen:
      seen, since = arrived.value, time.monotonic()
    time.sleep(0.01)


def _wake(pid: int, seconds: float) -> None:
  time.sleep(seconds)
  os.kill(pid, signal.SIGCONT)


def main(settings: Settings) -> None:
  """Runs both."""
  figures = {name: run(name, settings.messages, settings.stall) for name in ("zenoh", "link")}
  harness.finish("link", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
