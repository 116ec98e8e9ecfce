"""Warp's devices: quiet start, compiler options, aligned arrays, kernels on every CPU thread."""

import ctypes.util
import itertools
import os
import platform
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

_LINE_BYTES = 64  # of a cache line: vector loads of work arrays shall not cross two
# Warp compiles on the machine itself with -march=native; fused multiply-adds need a flag.
OPTIONS = {
  "fast_math": True,
  "optimization_level": 3,
  "cpu_compiler_flags": "-march=native -ffp-contract=fast",
}
# Loops written for vectors of samples (`vectors.CPU_LANES`) also need registers of 512 bits; clang
# takes narrower ones where a CPU has no AVX-512. The renderer's loops lose 15 % with them.
_WIDE = " -mprefer-vector-width=512" if platform.machine() in ("x86_64", "AMD64") else ""
WIDE_OPTIONS = OPTIONS | {"cpu_compiler_flags": f"{OPTIONS['cpu_compiler_flags']}{_WIDE}"}


def num_threads() -> int:
  """Threads to use: the cores that this process may run on."""
  return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start_quietly() -> None:
  """Starts Warp without its banner and without its warning that a machine has no GPU.

  That warning comes from compiled code, past Python's streams, so where there is no driver the
  process's standard error is turned away while Warp starts.
  """
  level = wp.config.log_level
  wp.config.log_level = wp.LOG_ERROR
  if ctypes.util.find_library("cuda"):
    wp.init()
  else:
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
      os.dup2(nowhere, 2)
      wp.init()
    finally:
      os.dup2(kept, 2)
      os.close(kept)
      os.close(nowhere)
  wp.config.log_level = max(level, wp.LOG_WARNING)


class Device:
  """A CPU's threads or a GPU: arrays there, and kernels that run there."""

  def __init__(self, name: str = "cpu", *, threads: int | None = None):
    """Starts Warp.

    Args:
      name: "cpu", "cuda" or another of Warp's names.
      threads: CPU threads; the cores of this process if None, 1 on a GPU.

    Raises:
      ValueError: There is no such device.
    """
    start_quietly()
    if name.startswith("cuda") and not wp.is_cuda_available():
      raise ValueError(f"No CUDA device was found for device={name!r}; use device='cpu'.")
    self.name = name
    self.is_cpu = name == "cpu"
    self.threads = threads or (num_threads() if self.is_cpu else 1)
    self._pool = ThreadPoolExecutor(self.threads)
    self._loaded: set[Any] = set()

  def put(self, array: np.ndarray, dtype: Any = None) -> Any:
    """Copies an array to the device; on a CPU to memory that starts at a cache line.

    Args:
      array: Any shape.
      dtype: Warp's type of the elements, such as wp.vec3; the array's own if None.
    """
    dtype = dtype or wp.dtype_from_numpy(array.dtype)
    if not self.is_cpu:
      return wp.array(array, dtype=dtype, device=self.name)
    raw = np.empty(array.nbytes + _LINE_BYTES, np.uint8)
    start = -raw.ctypes.data % _LINE_BYTES
    copy = raw[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return wp.array(copy, dtype=dtype, device="cpu", copy=False)

  def zeros(self, size: int, dtype: Any = np.float32) -> Any:
    """Zeros [size]; dtype is numpy's."""
    return self.put(np.zeros(size, dtype))

  def load(self, *kernels: Any) -> None:
    """Compiles kernels where that is due; before threads start them, as Warp takes no lock."""
    for kernel in kernels:
      if kernel not in self._loaded:
        wp.load_module(kernel.module, device=self.name)
        self._loaded.add(kernel)

  def launch(self, kernel: Any, inputs: list[Any], dim: int | tuple[int, ...] = 1) -> None:
    """Starts a kernel; on a CPU it runs on the calling thread."""
    wp.launch(kernel, dim=dim, inputs=inputs, device=self.name, record_tape=False)

  def run(self, work: Callable[[int], None]) -> None:
    """Runs work(thread) on every thread and waits; an exception of any is raised."""
    if self.threads == 1:
      work(0)  # on the caller's thread: callers are independent
    else:
      list(self._pool.map(work, range(self.threads)))

  def share(self, count: int) -> list[tuple[int, int]]:
    """Splits `count` things into the threads' stretches (first, behind the last)."""
    bounds = (count * thread // self.threads for thread in range(self.threads + 1))
    return list(itertools.pairwise(bounds))
