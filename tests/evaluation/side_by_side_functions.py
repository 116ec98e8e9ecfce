"""What tests run in other processes, which then import no more than this file needs."""

import os
import signal
import time


def number_and_process(number, say):
  say(f"number {number}")
  return number, os.getpid()


def fail(say):
  say("about to fail")
  raise ValueError("no such plant")


def die(say):
  os.kill(os.getpid(), signal.SIGKILL)


def write_late(path, say):
  time.sleep(20)
  path.touch()
