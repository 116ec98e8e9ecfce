"""The console command `nerf2real`: dispatches to the scripts of this folder.

`nerf2real evaluate --help` is `python launch/evaluate.py --help`.
"""

import ast
import difflib
import importlib
import sys
from pathlib import Path

SCRIPTS = {
  "scene": "make_scene",
  "film": "film_room",
  "view": "view",
  "export": "export_scene",
  "rollout": "rollout",
  "tune-gait": "tune_gait",
  "train": "local_distributed",
  "distill": "distill",
  "cluster": "cluster",
  "learner": "learner",
  "actor": "actor",
  "router": "router",
  "distill-learner": "distill_learner",
  "distill-collector": "actor",
  "belief": "show_belief",
  "evaluate": "evaluate",
  "robot": "check_robot",
  "virtual-robot": "virtual_robot",
  "camera": "calibrate_camera",
  "log": "replay_log",
  "identify": "identify",
  "loop": "close_loop",
}
"""Script of every command."""


def summary(script: str) -> str:
  """Returns the first line of a script's docstring; the script is parsed, not imported."""
  source = (Path(__file__).parent / f"{script}.py").read_text(encoding="utf-8")
  return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


def overview() -> str:
  """Returns the help of the command itself: a line for every command."""
  width = max(map(len, SCRIPTS))
  lines = [f"  {name:{width}}  {summary(script)}" for name, script in SCRIPTS.items()]
  head = "usage: nerf2real COMMAND [OPTIONS]; nerf2real COMMAND --help describes the options."
  return "\n".join([head, "", *lines])


def main() -> int:
  """Runs the command that the first argument names; returns the exit status."""
  name, *rest = sys.argv[1:] or [""]
  if name in ("-h", "--help"):
    print(overview())
    return 0
  if name not in SCRIPTS:
    near = difflib.get_close_matches(name, SCRIPTS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "see nerf2real --help."
    print(
      f"error: found command {name!r}, expected one of {', '.join(SCRIPTS)}: {hint}",
      file=sys.stderr,
    )
    return 2
  sys.argv = [f"nerf2real {name}", *rest]
  return importlib.import_module(f"nerf2real.launch.{SCRIPTS[name]}").main()


if __name__ == "__main__":
  sys.exit(main())
