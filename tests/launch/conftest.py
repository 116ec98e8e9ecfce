"""Commands run in this process: quick, and what they import is imported once."""

import importlib
import logging
import os
import signal
import sys
from typing import NamedTuple

import pytest


class Ended(NamedTuple):
  """How a command ended."""

  status: int
  out: str
  err: str


@pytest.fixture
def run(monkeypatch, capsys):
  """Runs a script with arguments; signals, environment and logging are as before afterwards."""
  environment = dict(os.environ)
  loggers = list(logging.getLogger().handlers)  # a script's would hold this test's closed streams
  handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}

  def call(script, *arguments):
    module = importlib.import_module(f"nerf2real.launch.{script}")
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *map(str, arguments)])
    try:
      status = module.main()
    except SystemExit as ended:
      status = ended.code if isinstance(ended.code, int) else 1
    return Ended(status, *capsys.readouterr())

  yield call
  for logger in set(logging.getLogger().handlers) - set(loggers):
    logging.getLogger().removeHandler(logger)
  for number, handler in handlers.items():
    signal.signal(number, handler)
  os.environ.clear()
  os.environ.update(environment)
