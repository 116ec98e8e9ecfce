"""Whether numba may keep the compiled kernels of this folder."""

from pathlib import Path

from nerf2real.core.kernel_cache import discard_stale

KERNEL_CACHE = discard_stale(
  Path(__file__).parent, ("fast_math", "grid", "kernels", "march", "network", "matrix_kernels")
)
