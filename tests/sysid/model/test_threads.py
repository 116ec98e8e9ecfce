"""Simulations beside each other come back in order."""

import threading
import time

from nerf2real.sysid.model import threads


def test_results_come_in_the_order_of_the_calls(monkeypatch):
  monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2})
  seen = set()

  def call(k):
    seen.add(threading.get_ident())
    time.sleep(0.01 * (k == 0))
    return k

  assert threads.at_once([lambda k=k: call(k) for k in range(12)]) == list(range(12))
  assert threading.get_ident() not in seen


def test_one_core_needs_no_threads(monkeypatch):
  monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})
  assert threads.at_once([threading.get_ident] * 3) == [threading.get_ident()] * 3
