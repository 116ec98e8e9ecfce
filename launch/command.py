"""What all commands share: arguments, environment variables, one-line errors, exit statuses.

A script has a frozen dataclass of arguments and a function of them; libraries are imported in that
function, so that `--help` answers at once and the environment is set before MuJoCo and BLAS load.
"""

import contextlib
import dataclasses
import math
import os
import shlex
import signal
import socket
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, TextIO

import tyro

from nerf2real.core.folder_lock import discarded_on, lock_folder

FAILED = 1  # exit status: the input or the machine was at fault
WRONG_ARGUMENTS = 2  # exit status, as of argparse and tyro: the same command cannot succeed
_LEARNER = ".learner.lock"  # beside the lock of the run's supervisor
_PATIENCE = 20.0  # s for a learner whose supervisor was killed to save what it has
_LAST_PORT = 65535
_IMPORT_PERIOD = 0.05  # s between interruptions of an import
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SIGNALLED = 128  # plus the signal's number: the shell's convention


class _Range(NamedTuple):
  """Which numbers an argument may have."""

  low: float
  high: float
  words: str
  open: bool = False  # whether `low` itself is none of them

  def holds(self, value: float) -> bool:
    above = value > self.low if self.open else value >= self.low
    return above and value <= self.high


_TIME = _Range(0, math.inf, "more than 0", open=True)
_STEPPED_TIME = _Range(0, sys.float_info.max, "more than 0, and finite", open=True)
_SEED = _Range(0, 2**32 - 1, f"0 to {2**32 - 1}")  # of NumPy's RandomState
_RANGES = {
  "port": _Range(0, _LAST_PORT, f"0 (a free one) to {_LAST_PORT}, such as 8080"),
  "seed": _SEED,
  "robot_seed": _SEED,
  "seconds": _STEPPED_TIME,
  "splat_seconds": _TIME,
  "minutes": _TIME,
  "time_limit": _STEPPED_TIME,
}
"""By the name of an argument, the same in all commands: a wrong one would be noticed late or never,
or end in words that do not name it."""

DRAWING = {"MUJOCO_GL": "egl"}
"""Environment of commands that draw through MuJoCo, also without a screen."""
NOT_DRAWING = {"MUJOCO_GL": "disabled"}
"""Environment of commands in which nothing draws through MuJoCo."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of commands whose matrices are small: BLAS threads would fight over the cores."""


class CommandError(Exception):
  """Ends a command with one line on stderr."""

  def __init__(self, message: object, *, status: int = FAILED):
    """Takes the message, without "error:", and the exit status."""
    super().__init__(str(message))
    self.status = status


class RefusedError(CommandError):
  """Ends a command that cannot start with its arguments: nothing is left of it."""

  def __init__(self, message: object):
    """Takes the message, without "error:"."""
    super().__init__(message, status=WRONG_ARGUMENTS)


def main(
  arguments: type,
  function: Callable[..., int | None],
  *,
  environment: Mapping[str, str] | None = None,
  errors: tuple[type[Exception], ...] = (ValueError, OSError),
  interrupted: str = "interrupted",
  forwards: bool = False,
) -> int:
  """Parses the command line, calls the function, and returns the exit status.

  Ctrl-C, SIGTERM and the end of the terminal (SIGHUP) raise KeyboardInterrupt in the function, so
  that what it opened is closed; they end in one line. Errors of other kinds than those listed show
  their trace.

  Args:
    arguments: dataclass of the arguments; its module's docstring is the help's description.
    function: called with the parsed arguments; returns an exit status, or None for 0.
    environment: environment variables that are set unless they are set already.
    errors: exceptions of the user's making, which end in `error: <message>` and status 1.
    interrupted: the line after one of these signals.
    forwards: calls the function with a list of unknown arguments besides.

  Raises:
    SystemExit: for --help (0) and wrong arguments (2).
  """
  for name, value in (environment or {}).items():
    os.environ.setdefault(name, value)
  description = sys.modules[arguments.__module__].__doc__
  values: tuple[Any, ...]
  try:
    if forwards:
      values = tyro.cli(arguments, description=description, return_unknown_args=True)
    else:
      values = (tyro.cli(arguments, description=description),)
  except BrokenPipeError:  # who reads the help, such as `head`, has seen enough
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _SIGNALLED + signal.SIGPIPE
  received = [signal.SIGINT]
  try:
    _check(values[0])
    with _terminated_as_interrupted(received), _warned_in_lines():
      return function(*values) or 0
  except CommandError as error:
    message, status = str(error), error.status
  except errors as error:
    message, status = _words(error), FAILED
  except KeyboardInterrupt:
    for number in _ENDING:  # a second one would only add a trace
      signal.signal(number, signal.SIG_IGN)
    _say(f"\n{interrupted}")
    return _SIGNALLED + received[-1]
  _say(f"error: {message}")
  return status


def _hide_interrupt(kind: type[BaseException], error: BaseException, trace: Any) -> None:
  """Ends in one line where Ctrl-C comes while a script still imports."""
  if issubclass(kind, KeyboardInterrupt):
    _say("\ninterrupted")
  else:
    sys.__excepthook__(kind, error, trace)


sys.excepthook = _hide_interrupt


def _check(arguments: Any) -> None:
  """Raises RefusedError for numbers that their arguments cannot have, and for a foreign address."""
  for name, value in vars(arguments).items():
    if dataclasses.is_dataclass(value):
      _check(value)
    option = f"--{name.replace('_', '-')}"
    for number in value if isinstance(value, tuple) else (value,):
      if isinstance(number, float) and math.isnan(number):
        raise RefusedError(f"{option} nan: expected a number.")
      allowed = _RANGES.get(name)
      if allowed and isinstance(number, int | float) and not allowed.holds(number):
        raise RefusedError(f"{option} {number:g}: expected {allowed.words}.")
  host = getattr(arguments, "host", None)
  if host is not None:
    _check_host(host)


def _check_host(host: str) -> None:
  """Raises RefusedError for what is no address of this machine; viser would wait for ever."""
  try:
    family = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0][0]
    with socket.socket(family) as probe:
      probe.bind((host, 0))
  except OSError as error:
    raise RefusedError(
      f"--host {host}: no address of this machine ({error.strerror}); expected such as 127.0.0.1, "
      "or 0.0.0.0 for all of them."
    ) from error


def _words(error: Exception) -> str:
  """Returns what an error says; of the system's errors the file first, without their number."""
  text = str(error)
  if isinstance(error, OSError) and text.startswith("[Errno") and error.strerror:
    about = error.filename2 or error.filename
    return f"{about}: {error.strerror.lower()}." if about else f"{error.strerror}."
  return text


def _say(text: str) -> None:
  """Prints to stderr; where that is a file on a full disk, the exit status remains."""
  with contextlib.suppress(OSError):
    print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _warned_in_lines() -> Iterator[None]:
  """Prints warnings to the user as lines, without the place in the source that Python's show."""

  def show(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
  ) -> None:
    if category is UserWarning:
      _say(f"warning: {message}")
    else:
      shown(message, category, filename, lineno, file, line)

  shown, warnings.showwarning = warnings.showwarning, show
  try:
    yield
  finally:
    warnings.showwarning = shown


@contextlib.contextmanager
def _terminated_as_interrupted(received: list[signal.Signals]) -> Iterator[None]:
  """Raises KeyboardInterrupt at Ctrl-C, SIGTERM and SIGHUP, and appends it to `received`.

  Where it comes during an import, it is raised until it is heeded: libraries that import others on
  trial (trimesh for one) take every exception there for a missing library, and go on. Where
  it comes in a destructor, whose exceptions Python drops, it is raised again after it.
  """

  def interrupt(number: int, frame: FrameType | None) -> None:
    received.append(signal.Signals(number))
    if _imports(frame):
      signal.setitimer(signal.ITIMER_REAL, _IMPORT_PERIOD, _IMPORT_PERIOD)
    raise KeyboardInterrupt

  def interrupt_again(number: int, frame: FrameType | None) -> None:
    if not isinstance(sys.exc_info()[1], KeyboardInterrupt):  # else it is being handled
      raise KeyboardInterrupt

  def dropped(unraisable: Any) -> None:
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
      period = signal.getitimer(signal.ITIMER_REAL)[1]  # that of an import, or none
      signal.setitimer(signal.ITIMER_REAL, _IMPORT_PERIOD, period)
    else:
      hook(unraisable)

  hook, sys.unraisablehook = sys.unraisablehook, dropped
  numbers = [signal.SIGTERM]
  if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell may have it ignored
    numbers.append(signal.SIGINT)
  if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # `nohup` has it ignored
    numbers.append(signal.SIGHUP)  # the terminal is gone: a robot must not be left under torque
  before = {number: signal.signal(number, interrupt) for number in numbers}
  before[signal.SIGALRM] = signal.signal(signal.SIGALRM, interrupt_again)
  try:
    yield
  finally:
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    sys.unraisablehook = hook
    for number, handler in before.items():
      signal.signal(number, handler)


def _imports(frame: FrameType | None) -> bool:
  """Returns whether a frame or one of its callers is that of an import."""
  while frame is not None:
    if frame.f_code.co_filename.startswith("<frozen importlib"):
      return True
    frame = frame.f_back
  return False


@contextlib.contextmanager
def learner_folder(run: Path) -> Iterator[None]:
  """Holds the lock of a run's folder, as its one learner; a refused start leaves nothing in it.

  Raises:
    CommandError: The folder cannot be written, or another learner writes it. This is no refusal for
      good: where the other one was on a machine that was lost, a supervisor tries again.
  """
  with contextlib.ExitStack() as stack:
    stack.enter_context(discarded_on(RefusedError, run))
    try:
      stack.enter_context(lock_folder(run, name=_LEARNER, patience=_PATIENCE))
    except OSError as error:
      raise CommandError(error) from error
    yield


def tell_port(asked: int, found: int) -> None:
  """Says that a page is not where it was asked to be: viser takes the next port of a taken one."""
  if asked and found != asked:
    _say(f"port {asked} is taken by another program: the page is on port {found}")


def command_line() -> str:
  """Returns the command that was given, as a shell takes it."""
  program = ["python", sys.argv[0]] if sys.argv[0].endswith(".py") else sys.argv[0].split()
  return shlex.join([*program, *sys.argv[1:]])
