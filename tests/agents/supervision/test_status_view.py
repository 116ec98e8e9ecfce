"""The figures of a run while it runs."""

from rich.console import Console

from nerf2real.agents.link.sessions import LinkSettings
from nerf2real.agents.supervision.status_view import StatusView

_LINK = {"queue": 0, "dropped": 0, "refused": 0, "duplicates": 0, "actors": 1}
_PARAMETERS = {"parameters_age": 0.5, "parameters_version": 3, "parameters_lag": 0}
_RUN = {"steps": 1200, "steps_per_second": 20.0, "updates": 3, "updates_per_second": 0.1}
_DISTILLATION = {"filled": True, "success": 0.5, "localisation_error": None, "replay_steps": 1200}


def shown(status):
  view = StatusView("a run", "tcp/127.0.0.1:1", LinkSettings())
  view.status = status
  console = Console(width=120)
  with console.capture() as capture:
    console.print(view.table(restarts=0, waiting=[]))
  return capture.get(), view.line(waiting=[])


def test_returns_are_shown_where_a_run_has_them():
  status = _RUN | _LINK | _PARAMETERS | _DISTILLATION
  table, line = shown(status)
  assert "return" not in table and "return" not in line
  assert "1,200 (20/s)" in table and "success 0.5" in line
  table, line = shown(status | {"return": 2.5, "evaluation": None, "best": 4.0})
  assert "2.5 acting, - evaluated, best 4" in table
  assert "return 2.5" in line and "evaluation" not in line


def test_what_a_learner_does_before_it_trains_is_shown():
  status = _RUN | _LINK | _PARAMETERS | _DISTILLATION | {"filled": False, "replay_needed": 8000}
  for view in shown(status):
    assert "filling the replay: 1,200 of 8,000" in view
  for view in shown(status | {"filled": True, "doing": "rendering views: 500 of 20,000"}):
    assert "rendering views: 500 of 20,000" in view and "filling" not in view
