"""A virtual robot in a process of its own, so that its work does not disturb the host's timing."""

import contextlib
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection as Pipe
from typing import Any

import numpy as np

from nerf2real.real.loading import Connection
from nerf2real.real.safety.operator import Hand
from nerf2real.real.virtual.body import Truth

_START_TIMEOUT = 120.0  # s: painting the room takes 10 s on an idle machine
_STOP_TIMEOUT = 5.0  # s


class VirtualRobotProcess:
  """Starts a `VirtualRobot` in another process; always in real time."""

  def __init__(self, **arguments: Any):
    """Starts the robot.

    Args:
      **arguments: Those of `VirtualRobot`, except `stepped` and `furnish`.

    Raises:
      RuntimeError: It did not start; the message holds the reason.
    """
    context = multiprocessing.get_context("spawn")
    self._pipe, theirs = context.Pipe()
    self._process = context.Process(target=_serve, args=(theirs, arguments), daemon=True)
    self._process.start()
    theirs.close()
    if not self._pipe.poll(_START_TIMEOUT):
      self.close()
      raise RuntimeError(f"The virtual robot did not start within {_START_TIMEOUT:.0f} s.")
    try:
      found = self._receive()
    except EOFError as error:
      raise RuntimeError("The virtual robot's process ended while it started.") from error
    self.port, self.camera_url = found
    self.operator = Hand(self.hold)

  def connection(self) -> Connection:
    """Returns what `real.load` needs, with this robot's person holding it on demand."""
    return Connection(port=self.port, camera=self.camera_url, operator=self.operator)

  def place(self, x: float, y: float, yaw: float) -> None:
    """Lifts the robot and holds it over a place [m] with a heading [rad]."""
    self._ask("place", x, y, yaw)

  def place_ball(self, x: float, y: float) -> None:
    """Puts the ball on the floor at a place [m]."""
    self._ask("place_ball", x, y)

  def hold(self, held: bool) -> None:
    """Takes the robot by its torso and lifts it, or lowers it to its feet and lets go."""
    self._ask("hold", held)

  def push(self, force: np.ndarray) -> None:
    """Pushes the torso with a force [3] [N] in the world, until the next call."""
    self._ask("push", np.asarray(force))

  def truth(self) -> Truth:
    """Returns the observer's present view of the robot."""
    return self._ask("truth")

  def set_faults(self, **faults: Any) -> None:
    """Sets fields of the robot's `Faults`."""
    self._ask("set_faults", faults)

  def processor_time(self) -> float:
    """Returns the processor time that the robot's process has used [s]."""
    return self._ask("processor_time")

  def close(self) -> None:
    """Ends the process."""
    with contextlib.suppress(OSError, ValueError):
      self._pipe.send(None)
    self._process.join(_STOP_TIMEOUT)
    if self._process.is_alive():
      self._process.terminate()
      self._process.join(_STOP_TIMEOUT)
    self._pipe.close()

  def __enter__(self) -> "VirtualRobotProcess":
    return self

  def __exit__(self, *_: object) -> None:
    self.close()

  def _ask(self, name: str, *arguments: Any) -> Any:
    try:
      self._pipe.send((name, arguments))
      return self._receive()
    except (EOFError, OSError) as error:
      raise RuntimeError("The virtual robot's process has ended: start it again.") from error

  def _receive(self) -> Any:
    found = self._pipe.recv()
    if isinstance(found, Exception):
      raise RuntimeError(f"The virtual robot: {found}") from found
    return found


def _serve(pipe: Pipe, arguments: dict[str, Any]) -> None:
  """Runs the robot and answers requests until the pipe ends."""
  from nerf2real.real.virtual.robot import VirtualRobot

  try:
    robot = VirtualRobot(**arguments)
  except Exception as error:
    pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))
    return

  def set_faults(faults: dict[str, Any]) -> None:
    for name, value in faults.items():
      if not hasattr(robot.faults, name):
        raise ValueError(f"There is no fault {name!r}.")
      setattr(robot.faults, name, value)

  extra: dict[str, Callable[..., Any]] = {
    "set_faults": set_faults,
    "processor_time": time.process_time,
  }
  with robot:
    pipe.send((robot.port, None if robot.stream is None else robot.stream.url))
    while True:
      try:
        request = pipe.recv()
      except (EOFError, OSError):
        return
      if request is None:
        return
      name, values = request
      try:
        pipe.send((extra.get(name) or getattr(robot, name))(*values))
      except Exception as error:
        pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))
