"""Stand-alone HTML pages: title, lead sentence, warnings, sections of blocks, origin.

Pages are rendered by jinja2 with autoescaping and written whole.
"""

import dataclasses
import functools
import importlib.metadata
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import jinja2
import numpy as np
import plotly.offline
from markupsafe import Markup

from nerf2real.core import files
from nerf2real.core.pages.blocks import Block, Chart

_TEMPLATES = Path(__file__).parent / "templates"


@dataclasses.dataclass(frozen=True)
class Section:
  """A titled part of a page: a sentence and blocks."""

  title: str
  text: str = ""
  blocks: Sequence[Block] = ()


@dataclasses.dataclass(frozen=True)
class Origin:
  """Where a page comes from; shown at its end."""

  command: str = ""
  version: str = ""

  @classmethod
  def of_process(cls) -> Self:
    """Returns the command line of this process and the version that is installed."""
    program, *arguments = sys.argv
    if Path(program).is_absolute():
      program = Path(program).name
    try:
      version = importlib.metadata.version("nerf2real")
    except importlib.metadata.PackageNotFoundError:
      version = ""
    return cls(command=shlex.join([program, *arguments]), version=version)


@dataclasses.dataclass(frozen=True)
class Page:
  """A report."""

  title: str
  lead: str
  sections: Sequence[Section]
  warnings: Sequence[str] = ()
  origin: Origin = Origin()


def write(path: str | Path, page: Page) -> None:
  """Writes a report as one file that opens offline.

  Raises:
    OSError: The file cannot be written.
  """
  plots = any(_has_chart(section.blocks) for section in page.sections)
  files.write_atomically(path, render(_TEMPLATES / "page.html", page=page, plots=plots))


def render(template: Path, *, plots: bool, **values: Any) -> str:
  """Returns a page from a template that extends `base.html`.

  Args:
    template: File of the template.
    plots: Inlines plotly.js; the page's scripts then have `Plotly`, and `LOOK`, a plotly template.
    values: Names of the template; `tojson` takes dataclasses and arrays, too.

  Raises:
    jinja2.TemplateError: The template is damaged or uses a name that is not among the values.
  """
  source = Markup(plotly.offline.get_plotlyjs()) if plots else ""
  return _environment(template.parent).get_template(template.name).render(plotly=source, **values)


@functools.cache
def _environment(folder: Path) -> jinja2.Environment:
  environment = jinja2.Environment(
    loader=jinja2.FileSystemLoader([folder, _TEMPLATES]),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
  )
  environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "default": _plain}
  environment.filters["cell"] = lambda value: f"{value:.4g}" if isinstance(value, float) else value
  return environment


def _plain(value: Any) -> Any:
  """Converts arrays and dataclasses to JSON values; fields that are None are omitted."""
  if isinstance(value, np.ndarray | np.generic):
    return value.tolist()
  if dataclasses.is_dataclass(value):
    return {name: field for name, field in vars(value).items() if field is not None}
  raise TypeError(f"A page's script got a {type(value).__name__}; expected JSON's types.")


def _has_chart(blocks: Sequence[Block | None]) -> bool:
  return any(
    isinstance(block, Chart) or _has_chart(block.inner) for block in blocks if block is not None
  )
