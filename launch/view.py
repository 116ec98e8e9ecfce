"""Shows a scene bundle, or a task in it, in the browser.

  python launch/view.py out/livingroom
  python launch/view.py out/livingroom --splats livingroom.ply
  python launch/view.py --task nerf_nav
  python launch/view.py --task nerf_nav --policy runs/nav

In a task the robot can be pushed: by the buttons, or by the handle above it.
"""

import contextlib
import dataclasses
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Shows a scene bundle, or a task in it, in the browser."""

  bundle: Annotated[Path | None, tyro.conf.Positional] = None
  """Folder of the scene bundle; the built-in room if not given."""
  task: str | None = None
  """Shows a task of the suite in the scene, such as nerf_nav, instead of the scene alone."""
  splats: Path | None = None
  """Splats to show as a layer, as launch/export_scene.py --to splat writes them."""
  policy: str = "walker"
  """What acts in a task: walker, shipped, a run's folder, an exported policy's, stand or random."""
  host: str = "127.0.0.1"
  """Address to serve on; 0.0.0.0 lets other machines connect."""
  port: int = 8080
  """Port to serve on; 0 takes a free one. Where it is taken the next one is, and the command says
  so."""


def run(arguments: Arguments) -> None:
  """Serves until interrupted."""
  host, port = arguments.host, arguments.port
  never = threading.Event()
  wait: Callable[[], object] = never.wait
  if arguments.task is not None:
    from nerf2real.evaluation.policies.driving import choose_driver
    from nerf2real.suite.views.drivers import SCRIPTED
    from nerf2real.suite.views.task_viewer import view_task

    chosen = choose_driver(arguments.policy, task=arguments.task)
    viewer = view_task(
      arguments.task,
      scene=arguments.bundle,
      drivers={chosen.name: chosen.make} | SCRIPTED,
      image_size=chosen.image_size or (30, 40),
      camera=chosen.camera,
      host=host,
      port=port,
    )
    server, wait = viewer.server, lambda: viewer.run(never)
  else:
    from nerf2real.scenes.bundle import Bundle
    from nerf2real.scenes.export.splats.splats import Splats
    from nerf2real.scenes.viewing.bundle_viewer import view_bundle

    splats = None if arguments.splats is None else Splats.load_ply(arguments.splats)
    server = view_bundle(Bundle.load(arguments.bundle), host=host, port=port, splats=splats)
  command.tell_port(port, server.get_port())
  print(f"open http://{host}:{server.get_port()} (Ctrl-C ends)", flush=True)
  with contextlib.suppress(KeyboardInterrupt):
    wait()
  server.stop()


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run)


if __name__ == "__main__":
  sys.exit(main())
