"""What a section of a report shows: answers, pictures, grids, tables, figures, charts, text.

Blocks hold content; `templates/blocks.html` lays each kind out.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import plotly.graph_objects as go

from nerf2real.core.pages import pictures


class Block:
  """Anything that a section shows."""

  kind: ClassVar[str]  # of its layout in templates/blocks.html

  @property
  def inner(self) -> Sequence["Block | None"]:
    """The blocks in this block."""
    return ()


@dataclasses.dataclass(frozen=True)
class Text(Block):
  """A paragraph."""

  kind = "text"
  text: str


@dataclasses.dataclass(frozen=True)
class Heading(Block):
  """A title within a section."""

  kind = "heading"
  text: str


@dataclasses.dataclass(frozen=True)
class Warnings(Block):
  """Highlighted lines."""

  kind = "warnings"
  messages: Sequence[str]


@dataclasses.dataclass(frozen=True)
class Notes(Block):
  """Lines set apart that warn of nothing."""

  kind = "notes"
  messages: Sequence[str]


@dataclasses.dataclass(frozen=True)
class Answer:
  """A question that a reader has, its answer in a few words, and what the answer rests on."""

  question: str
  answer: str
  details: Sequence[str] = ()
  tone: str = ""
  """"good", "warn" or none: the colour of its edge."""
  bars: Mapping[str, float] = dataclasses.field(default_factory=dict)
  """Quantities of one kind by name, shown as bars beneath."""


@dataclasses.dataclass(frozen=True)
class Answers(Block):
  """What a page says, before its tables: a card an answer, two side by side where there is room."""

  kind = "answers"
  answers: Sequence[Answer]


@dataclasses.dataclass(frozen=True)
class Picture(Block):
  """A picture, RGB uint8 [H, W, 3] or grey [H, W]; where pixels matter lossless and sharp."""

  kind = "picture"
  image: np.ndarray
  caption: str = ""
  pixelated: bool = False

  @property
  def source(self) -> str:
    """The embedded picture."""
    return pictures.data_uri(self.image, lossless=self.pixelated)


@dataclasses.dataclass(frozen=True)
class Grid(Block):
  """Blocks in columns of equal width, row by row; None is an empty cell."""

  kind = "grid"
  cells: Sequence[Block | None]
  columns: int

  @property
  def inner(self) -> Sequence[Block | None]:
    """The cells."""
    return self.cells


@dataclasses.dataclass(frozen=True)
class Table(Block):
  """A table; floats are shown with four digits, numbers in tabular figures."""

  kind = "table"
  header: Sequence[str]
  rows: Sequence[Sequence[Any]]
  small: bool = False


@dataclasses.dataclass(frozen=True)
class Figure:
  """A number or word of a result, with what it means."""

  name: str
  value: Any
  unit: str = ""
  meaning: str = ""
  good: str = ""
  """Which values are good, such as "higher" or "below 1"."""


@dataclasses.dataclass(frozen=True)
class Figures(Block):
  """A table of figures with unit and meaning, and with what is good where any row has that.

  Figures whose values stand elsewhere, such as in the columns of a table or in a chart, have None:
  where all do, the table has no column of values.
  """

  kind = "figures"
  figures: Sequence[Figure]

  @property
  def table(self) -> Table:
    """The same as a table."""
    valued = any(figure.value is not None for figure in self.figures)
    columns = ["name", *(["value"] if valued else []), "unit", "meaning"]
    header = ["figure", *columns[1:]]
    if any(figure.good for figure in self.figures):
      columns, header = [*columns, "good"], [*header, "good is"]
    return Table(header, [[getattr(f, column) for column in columns] for f in self.figures])


@dataclasses.dataclass(frozen=True)
class Times(Block):
  """Durations [s] by name as bars, with their total."""

  kind = "times"
  seconds: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Legend(Block):
  """Names of colours in CSS."""

  kind = "legend"
  colors: Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class Chart(Block):
  """A plotly figure with a height in its layout; `charts` makes them."""

  kind = "chart"
  figure: go.Figure
  tools: bool = False
  """Shows plotly's buttons."""

  @property
  def content(self) -> dict[str, Any]:
    """Traces and layout, without plotly's own template."""
    content = self.figure.to_plotly_json()
    content["layout"].pop("template", None)
    return content


@dataclasses.dataclass(frozen=True)
class Preformatted(Block):
  """Text as it is, such as JSON."""

  kind = "preformatted"
  text: str


@dataclasses.dataclass(frozen=True)
class Details(Block):
  """Blocks folded under a title."""

  kind = "details"
  title: str
  blocks: Sequence[Block]

  @property
  def inner(self) -> Sequence[Block]:
    """The folded blocks."""
    return self.blocks
