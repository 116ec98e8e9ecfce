"""Runs compiled simulations beside each other, one thread a core: the kernel holds no lock."""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def at_once(calls: Sequence[Callable[[], T]]) -> list[T]:
  """Returns what calls return, in their order."""
  cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
  if cores == 1 or len(calls) < 2:
    return [call() for call in calls]
  return list(_pool(os.getpid(), cores).map(lambda call: call(), calls))


@functools.cache
def _pool(process: int, cores: int) -> ThreadPoolExecutor:
  """Returns the threads of a process: a forked one has none of its parent's."""
  return ThreadPoolExecutor(cores, thread_name_prefix=f"simulation-{process}")
