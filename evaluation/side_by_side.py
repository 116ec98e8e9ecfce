"""Functions in processes side by side, each with simulations, plants and pictures of its own."""

import itertools
import multiprocessing
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")
Say = Callable[[str], None]

_SAID, _RETURNED, _FAILED = "said", "returned", "failed"


class _Running(NamedTuple):
  number: int  # of the function
  process: Any
  messages: Connection


def run(functions: Sequence[Callable[[Say], T]], *, processes: int, say: Say) -> list[T]:
  """Returns what functions return, in their order; an error or an interruption ends them all.

  Args:
    functions: Called with a function that says a line; picklable, as are what they return and
      raise.
    processes: How many at a time; with 1, or of one function, in this process.
    say: Called with every line.

  Raises:
    Exception: What one of them raised.
    RuntimeError: A process ended before its function returned.
  """
  if processes == 1 or len(functions) == 1:
    return [function(say) for function in functions]
  results: dict[int, T] = {}
  waiting = iter(enumerate(functions))
  running = [_start(*one) for one in itertools.islice(waiting, processes)]
  try:
    while running:
      ready = wait([one.messages for one in running])
      for one in [one for one in running if one.messages in ready]:
        kind, value = _received(one)
        if kind == _SAID:
          say(value)
          continue
        if kind == _FAILED:
          raise value
        results[one.number] = value
        one.process.join()
        running.remove(one)
        running += [_start(*following) for following in itertools.islice(waiting, 1)]
  finally:
    for one in running:
      one.process.terminate()
      one.process.join()
  return [results[number] for number in range(len(functions))]


def _start(number: int, function: Callable[[Say], Any]) -> _Running:
  context = multiprocessing.get_context("spawn")  # threads and OpenGL outlive no fork
  reader, writer = context.Pipe(duplex=False)
  process = context.Process(target=_work, args=(function, writer), daemon=True)
  process.start()
  writer.close()
  return _Running(number, process, reader)


def _received(one: _Running) -> tuple[str, Any]:
  try:
    return one.messages.recv()
  except EOFError:
    one.process.join()
    raise RuntimeError(
      f"A process ended with status {one.process.exitcode} before its work was done (out of "
      "memory?): the same command goes on, with fewer --processes if need be."
    ) from None


def _work(function: Callable[[Say], Any], messages: Connection) -> None:
  signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
  try:
    messages.send((_RETURNED, function(lambda line: messages.send((_SAID, line)))))
  except Exception as error:
    messages.send((_FAILED, error))
