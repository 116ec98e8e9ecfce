"""Shows a recorded log in the browser: plots of every joint and the IMU, and the camera.

python launch/replay_log.py out/evaluation/virtual_navigation.mcap
python launch/replay_log.py log.mcap --html log.html    # one file that needs no server
"""

import contextlib
import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Shows a recorded log in the browser."""

  log: Annotated[Path, tyro.conf.Positional]
  """The log (.mcap), also one whose recorder was killed."""
  html: Path | None = None
  """Writes the page to a file with all pictures in it, instead of serving it."""
  host: str = "127.0.0.1"
  """Address to serve on; 0.0.0.0 lets other machines connect."""
  port: int = 8080
  """Port to serve on; 0 takes a free one."""


def run(arguments: Arguments) -> None:
  """Writes the page, or serves it until interrupted."""
  from nerf2real.core.files import write_atomically
  from nerf2real.real.recorder import replay, replay_server

  shown = replay.load(arguments.log)
  if arguments.html is not None:
    write_atomically(arguments.html, replay.page(shown, embed=True))
    print(f"wrote {arguments.html}")
    return
  server = replay_server.make_server(shown, host=arguments.host, port=arguments.port)
  print(f"open http://{arguments.host}:{server.server_port} (Ctrl-C ends)", flush=True)
  with contextlib.suppress(KeyboardInterrupt), server:
    server.serve_forever()


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run)


if __name__ == "__main__":
  sys.exit(main())
