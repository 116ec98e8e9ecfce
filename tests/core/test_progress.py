"""Parts of a computation report their share of the whole."""

import io
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from nerf2real.core import progress as progress_module
from nerf2real.core.progress import no_progress, part, progress_bar

fractions = st.floats(0.0, 1.0)


@given(ends=st.tuples(fractions, fractions).map(sorted), fraction=st.floats(-1.0, 2.0))
def test_a_part_stays_in_its_share(ends, fraction):
  reports: list[tuple[float, str]] = []
  start, end = ends
  part(lambda *report: reports.append(report), start, end)(fraction, "text")
  ((found, text),) = reports
  assert start - 1e-12 <= found <= end + 1e-12 and text == "text"
  if 0 <= fraction <= 1:
    assert found == pytest.approx(start + (end - start) * fraction)


def test_parts_nest():
  reports: list[float] = []
  half = part(lambda fraction, _: reports.append(fraction), 0.5, 1.0)
  part(half, 0.0, 0.5)(1.0, "")
  assert reports == [0.75]


def test_the_bar_shows_name_and_text():
  stream = io.StringIO()
  console = Console(file=stream, width=120, force_terminal=True)
  with progress_bar("depth", console=console) as progress:
    progress(0.5, "picture 1 of 2")
  for word in ("depth", "50%", "picture 1 of 2"):
    assert word in stream.getvalue()


def test_a_hidden_bar_is_silent(capsys):
  with progress_bar("depth", shown=False) as progress:
    progress(0.5, "picture 1 of 2")
  assert progress is no_progress and capsys.readouterr().out == ""


def test_a_pipe_gets_lines_with_the_time_left(monkeypatch):
  now = [0.0]
  monkeypatch.setattr(time, "monotonic", lambda: now[0])
  stream = io.StringIO()
  with progress_bar("depth", console=Console(file=stream)) as progress:
    for now[0], fraction in ((1.0, 0.01), (20.0, 0.25), (25.0, 0.3), (80.0, 1.0)):
      progress(fraction, "picture")
  assert stream.getvalue().splitlines() == [
    "depth: 25% after 20 s, about 60 s left: picture",
    "depth: 100% after 80 s: picture",
  ]


def test_a_silence_does_not_make_the_rest_longer(monkeypatch):
  now = [0.0]
  monkeypatch.setattr(time, "monotonic", lambda: now[0])
  stream = io.StringIO()
  lines = progress_module._Lines("depth", Console(file=stream))
  now[0] = 20.0
  lines(0.25, "picture")
  for now[0] in (50.0, 90.0):
    lines._print()
  assert stream.getvalue().splitlines() == [
    "depth: 25% after 20 s, about 60 s left: picture",
    "depth: 25% after 50 s, about 30 s left: picture",
    "depth: 25% after 90 s: picture",
  ]


def test_a_short_stage_says_nothing_in_a_pipe():
  stream = io.StringIO()
  with progress_bar("depth", console=Console(file=stream)) as progress:
    progress(1.0, "done before")
  assert stream.getvalue() == ""


def test_a_pipe_is_told_what_is_done_in_a_long_silence(monkeypatch):
  monkeypatch.setattr(progress_module, "_LINE_PERIOD", 0.02)
  monkeypatch.setattr(progress_module, "_SILENCE", 0.05)
  stream = io.StringIO()
  with progress_bar("poses", console=Console(file=stream)) as progress:
    progress(0.5, "adjusting")
    deadline = time.monotonic() + 10
    while "adjusting" not in stream.getvalue() and time.monotonic() < deadline:
      time.sleep(0.01)
  assert stream.getvalue().startswith("poses: 50% after 0 s")
