"""The operator: a key that stops the robot, and questions such as to hold it."""

import contextlib
import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable
from typing import Protocol

_LOOK_PERIOD = 0.02  # s between looks for the answer to a question
_ESCAPE, _ERASE, _ENTER = 0x1B, b"\x08\x7f", b"\r\n"  # keys


class Operator(Protocol):
  """Who stands beside the robot."""

  def pressed(self) -> bool:
    """Returns whether a key was pressed since the last call; never waits."""

  def support(self, held: bool) -> None:
    """Requests to hold the robot (True) or to let it go (False); returns when that is so.

    Raises:
      RuntimeError: Nobody can be asked, or nobody is there any more to answer.
    """

  def close(self) -> None:
    """Gives the terminal back."""


class Terminal:
  """A person at a terminal: any key stops the robot, Enter confirms.

  The bus's thread looks for keys all the time, also while a question waits. So questions at this
  terminal go through `ask`: `input` would compete for the keys, and an answer would be a stop.
  """

  def __init__(self, descriptor: int | None = None):
    """Takes a terminal; standard input if None. Without a terminal there are no keys."""
    self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
    self._open = os.isatty(self._descriptor)
    self._settings = termios.tcgetattr(self._descriptor) if self._open else None
    self._lock = threading.Lock()
    self._asking = self._confirmed = self._stopped = False
    self._answer: bytearray | None = None  # to a question, as far as it has been typed
    if self._open:
      tty.setcbreak(self._descriptor, termios.TCSAFLUSH)  # what was typed before is no key

  def pressed(self) -> bool:
    self._take()
    with self._lock:
      found, self._stopped = self._stopped, False
    return found

  def support(self, held: bool) -> None:
    if not self._open:
      raise RuntimeError(
        "Nobody can be asked to hold the robot: standard input is no terminal. Run it in one."
      )
    asked = "HOLD the robot by its torso, feet off the ground" if held else "Set it down, let go"
    print(f"\n{asked}, then press Enter. Any other key stops.", flush=True)
    self._take()  # what was typed before the question is no answer to it
    with self._lock:
      self._confirmed, self._asking = False, True
    while self._open and not self._confirmed:
      self._take()
      time.sleep(_LOOK_PERIOD)
    with self._lock:
      self._asking = False
    if not self._confirmed:
      raise RuntimeError("The terminal is gone: nobody confirms to hold the robot, or to let go.")

  def ask(self, question: str) -> str:
    """Returns the line typed to a question; meanwhile Escape stops the robot, no other key."""
    if not self._open:
      return input(question)
    print(question, end="", flush=True)
    answer = bytearray()
    with self._lock:
      self._answer = answer
    while self._open and not answer.endswith(b"\n"):
      self._take()
      time.sleep(_LOOK_PERIOD)
    with self._lock:
      self._answer = None
    if not self._open:
      raise RuntimeError("The terminal is gone: nobody answers.")
    print(flush=True)
    return answer.decode(errors="replace").strip()

  def _type(self, answer: bytearray, keys: bytes) -> None:
    """Adds keys to an answer, up to the end of its line."""
    for key in keys:
      if key == _ESCAPE:
        self._stopped = True
      elif key in _ERASE:
        del answer[-1:]
      elif key in _ENTER:
        answer += b"\n"
        return
      else:
        answer.append(key)
        print(chr(key), end="", flush=True)  # the terminal does not echo

  def _take(self) -> None:
    """Takes the keys that were pressed."""
    with self._lock:
      if not self._open or not select.select((self._descriptor,), (), (), 0)[0]:
        return
      try:
        keys = os.read(self._descriptor, 1024)
      except OSError:
        keys = b""
      if not keys:  # the terminal is gone, and with it who could stop the robot
        self._open, self._stopped = False, True
      elif self._answer is not None:
        self._type(self._answer, keys)
      elif self._asking and set(keys) <= set(b"\r\n"):
        self._confirmed = True
      else:
        self._stopped = True

  def close(self) -> None:
    if self._settings is not None:
      with contextlib.suppress(termios.error, OSError):
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._settings)
      self._settings = None
    self._open = False


class Hand:
  """An operator in a rehearsal: something else holds the robot, and keys are pressed by `press`."""

  def __init__(self, hold: Callable[[bool], None] = lambda held: None):
    """Takes a function that holds (True) or releases (False) the robot."""
    self._hold = hold
    self._pressed = False

  def press(self) -> None:
    """Presses the stop key."""
    self._pressed = True

  def pressed(self) -> bool:
    found, self._pressed = self._pressed, False
    return found

  def support(self, held: bool) -> None:
    self._hold(held)

  def close(self) -> None:
    """Has nothing to give back."""
