"""A view in the browser."""

import socket
import time

from nerf2real.core import browser_view


def test_a_connection_that_is_opened_ahead_and_closed_leaves_no_traceback(caplog):
  server = browser_view.serve("a view", host="127.0.0.1", port=0)
  try:
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=5):
      pass
    time.sleep(0.5)
  finally:
    server.stop()
  assert not [r for r in caplog.records if r.name.startswith("websockets")]
