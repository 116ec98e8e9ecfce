"""Shows a recorded log in the browser: plots of every joint and the IMU, and the camera.

python launch/replay_log.py out/evaluation/virtual_navigation.mcap
python launch/replay_log.py log.mcap --html log.html    # one file that needs no server
"""

import dataclasses
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import tyro

from nerf2real.real.recorder import replay


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


def make_server(shown: replay.Replay, *, host: str, port: int) -> ThreadingHTTPServer:
  """Returns a server of the page and its pictures; call its serve_forever."""
  page = replay.page(shown, embed=False).encode()

  class Handler(BaseHTTPRequestHandler):
    """Answers / and /frame/<number>."""

    def do_GET(self) -> None:
      if self.path == "/":
        self._answer(page, "text/html; charset=utf-8")
        return
      number = self.path.removeprefix("/frame/")
      if self.path.startswith("/frame/") and number.isdigit() and int(number) < len(shown.frames):
        self._answer(shown.frames[int(number)][1], "image/jpeg")
      else:
        self.send_error(404)

    def _answer(self, body: bytes, kind: str) -> None:
      self.send_response(200)
      self.send_header("Content-Type", kind)
      self.send_header("Content-Length", str(len(body)))
      self.end_headers()
      self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
      """Keeps the console quiet."""

  return ThreadingHTTPServer((host, port), Handler)


def main() -> None:
  """Parses the command line; writes the page or serves it until interrupted."""
  arguments = tyro.cli(Arguments, description=__doc__)
  try:
    shown = replay.load(arguments.log)
    if arguments.html is not None:
      arguments.html.write_text(replay.page(shown, embed=True))
      print(f"wrote {arguments.html}")
      return
    server = make_server(shown, host=arguments.host, port=arguments.port)
  except (ValueError, OSError) as error:
    sys.exit(f"error: {error}")
  print(f"open http://{arguments.host}:{server.server_port} (Ctrl-C ends)", flush=True)
  try:
    server.serve_forever()
  except KeyboardInterrupt:
    server.server_close()


if __name__ == "__main__":
  main()
