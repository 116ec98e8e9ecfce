"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
  """Returns a table of cells as their text, without a line break at its end."""
  lines = ["| " + " | ".join(map(str, row)) + " |" for row in (header, *rows)]
  return "\n".join([lines[0], "| --- " * len(header) + "|", *lines[1:]])
