"""Serves the page of a recorded log and its pictures over HTTP."""

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from nerf2real.real.recorder import replay


def make_server(shown: replay.Replay, *, host: str, port: int) -> ThreadingHTTPServer:
  """Returns a server of the page and its pictures; call its serve_forever.

  Raises:
    ValueError: It cannot listen there, such as at a port that is taken.
  """
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

  try:
    return ThreadingHTTPServer((host, port), Handler)
  except OSError as error:
    raise ValueError(
      f"Cannot serve at {host}:{port} ({error.strerror}): another port is given with --port, 0 for "
      "a free one."
    ) from error
