"""Set-up of all tests: MuJoCo draws through EGL where there is no screen, as on a server; BLAS has
one thread, as in the commands, since tests run side by side; what JAX compiled is kept until the
session ends, for all its processes."""

import os
import shutil
import signal
import tempfile
from importlib.metadata import version

from hypothesis import settings

# A shell has commands in the background ignore Ctrl-C, and what the tests start would inherit it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
  signal.signal(signal.SIGINT, signal.default_int_handler)

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
  os.environ.setdefault(_name, "1")  # read when numpy is imported

if "DISPLAY" not in os.environ:
  os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported, so before anything else

# Read when jax is imported. Workers and what tests start inherit it; nothing outlives the session.
_compiled = None
if "PYTEST_XDIST_WORKER" not in os.environ:
  _compiled = tempfile.mkdtemp(prefix="compiled-")
  os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
  os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
  if version("jaxlib").startswith("0.10."):  # one that does not know a flag ends the process
    # XLA's newer emitters of fused loops take three times as long to compile an update.
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_cpu_use_fusion_emitters=false"]
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()

# The first example of a test may wait for imports, compilers or other programs of the machine.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


def pytest_unconfigure():
  if _compiled is not None:
    shutil.rmtree(_compiled, ignore_errors=True)
