"""What a person at the terminal is asked, and how a key stops the robot."""

import os
import pty
import select
import threading
import time

import pytest

from nerf2real.real.safety.operator import Terminal


def test_a_key_on_a_terminal_is_seen_once():
  master, slave = pty.openpty()
  try:
    terminal = Terminal(slave)
    assert not terminal.pressed()
    os.write(master, b" ")
    assert _soon(terminal.pressed) and not terminal.pressed()
    terminal.close()
    os.write(master, b" ")
    assert not terminal.pressed()
  finally:
    os.close(master)
    os.close(slave)


def test_enter_answers_a_question_and_any_other_key_stops():
  master, slave = pty.openpty()
  try:
    terminal = Terminal(slave)
    asked = threading.Thread(target=terminal.support, args=(True,), daemon=True)
    asked.start()
    assert _soon(lambda: terminal._asking)
    os.write(master, b"x")
    assert _soon(terminal.pressed)  # as the bus's thread looks for it
    assert asked.is_alive()
    os.write(master, b"\r")
    assert _soon(lambda: terminal.pressed() or not asked.is_alive())
    assert not asked.is_alive() and not terminal.pressed()
    terminal.close()
  finally:
    os.close(master)
    os.close(slave)


def test_what_was_typed_before_the_question_is_no_answer():
  master, slave = pty.openpty()
  try:
    os.write(master, b"\n")  # while the program starts
    assert _soon(lambda: _arrived(slave))
    terminal = Terminal(slave)
    assert not terminal.pressed()
    os.write(master, b"\n")  # before it asks
    assert _soon(lambda: _arrived(slave))
    asked = threading.Thread(target=terminal.support, args=(True,), daemon=True)
    asked.start()
    assert _soon(lambda: terminal._asking)
    assert _soon(terminal.pressed) and asked.is_alive()
    os.write(master, b"\n")
    assert _soon(lambda: not asked.is_alive()) and not terminal.pressed()
    terminal.close()
  finally:
    os.close(master)
    os.close(slave)


def test_a_terminal_that_goes_away_confirms_nothing():
  master, slave = pty.openpty()
  terminal = Terminal(slave)
  gone = threading.Timer(0.2, lambda: os.close(master))
  gone.start()
  try:
    with pytest.raises(RuntimeError, match="nobody confirms"):
      terminal.support(True)
    assert terminal.pressed()
  finally:
    gone.join()
    terminal.close()
    os.close(slave)


def test_a_key_that_a_question_takes_meanwhile_is_not_lost(monkeypatch):
  master, slave = pty.openpty()
  question = []

  class Watched(Terminal):
    """A question reads the keys while `pressed` looks at what was found before."""

    def __getattribute__(self, name):
      found = object.__getattribute__(self, name)
      if name == "_stopped" and question and not found:
        question.pop()
        asking = threading.Thread(target=self._take, daemon=True)
        asking.start()
        asking.join(0.2)  # where it waits for `pressed`, it takes the key later
      return found

  try:
    terminal = Watched(slave)
    assert not terminal.pressed()
    take = terminal._take

    looks = []

    def late():  # the key comes just after `pressed` looked for it
      looks.append(True)
      if len(looks) == 1:
        take()
        os.write(master, b"x")
        question.append(True)
      else:
        take()

    monkeypatch.setattr(terminal, "_take", late)
    assert _soon(terminal.pressed)
    terminal.close()
  finally:
    os.close(master)
    os.close(slave)


def test_a_typed_answer_is_no_stop_though_the_bus_looks_for_keys():
  master, slave = pty.openpty()
  stops, ended, answers = [], threading.Event(), []
  terminal = Terminal(slave)

  def bus():
    while not ended.is_set():
      stops.append(terminal.pressed())

  thief = threading.Thread(target=bus, daemon=True)
  thief.start()
  try:
    for typed, expected in ((b"s\r", "s"), (b"lx\x7f\n", "l"), (b"\n", "")):
      asked = threading.Thread(target=lambda: answers.append(terminal.ask("What? ")), daemon=True)
      asked.start()
      assert _soon(lambda: terminal._answer is not None)
      for key in typed:
        os.write(master, bytes((key,)))
      assert _soon(lambda asked=asked: not asked.is_alive())
      assert answers[-1] == expected
    assert not any(stops)
    asked = threading.Thread(target=lambda: answers.append(terminal.ask("What? ")), daemon=True)
    asked.start()
    assert _soon(lambda: terminal._answer is not None)
    os.write(master, b"\x1b")  # Escape stops even then
    assert _soon(lambda: any(stops)) and asked.is_alive()
    os.write(master, b"\n")
    assert _soon(lambda: not asked.is_alive())
  finally:
    ended.set()
    thief.join()
    terminal.close()
    os.close(master)
    os.close(slave)


def test_without_a_terminal_nobody_can_be_asked():
  read, write = os.pipe()
  try:
    terminal = Terminal(read)
    assert not terminal.pressed()
    with pytest.raises(RuntimeError, match="terminal"):
      terminal.support(True)
  finally:
    os.close(read)
    os.close(write)


def _arrived(descriptor):
  return select.select((descriptor,), (), (), 0)[0]


def _soon(condition):
  for _ in range(100):
    if condition():
      return True
    time.sleep(0.01)
  return False
