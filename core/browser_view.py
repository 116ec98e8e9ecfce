"""A view in the browser, served by viser."""

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
  import viser


def serve(label: str, *, host: str, port: int) -> "viser.ViserServer":
  """Returns a server of a view.

  A browser opens connections ahead and closes them unused, each of which would end in a traceback
  on the terminal of whoever looks.

  Args:
    label: title of the view.
    host: address to serve on.
    port: the next free one is taken where it is in use.
  """
  import viser

  logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
  return viser.ViserServer(host=host, port=port, label=label, verbose=False)
