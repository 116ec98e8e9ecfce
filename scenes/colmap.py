"""Imports pycolmap and puts the handler of SIGTERM back, which its import replaces.

pycolmap installs glog's failure handler, which prints a C++ stack trace at SIGTERM and ends the
process before Python's own handler can run. All modules take pycolmap from here.
"""

import signal
import threading

_handler = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, TID251

# Python sets handlers in its main thread alone; None: the handler was not set from Python
if threading.current_thread() is threading.main_thread() and _handler is not None:
  signal.signal(signal.SIGTERM, _handler)

__all__ = ["pycolmap"]
