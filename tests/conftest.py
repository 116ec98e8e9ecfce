"""Set-up of all tests: MuJoCo draws through EGL where there is no screen, as on a server; BLAS has
one thread, as in the commands, since tests run side by side."""

import os
import signal

from hypothesis import settings

# A shell has commands in the background ignore Ctrl-C, and what the tests start would inherit it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
  signal.signal(signal.SIGINT, signal.default_int_handler)

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
  os.environ.setdefault(_name, "1")  # read when numpy is imported

if "DISPLAY" not in os.environ:
  os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported, so before anything else

# The first example of a test may wait for imports, compilers or other programs of the machine.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")
