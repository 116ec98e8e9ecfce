"""Colours of all plots, maps and pages: the palette of Okabe and Ito for the colour blind.

Source: Okabe and Ito 2008, Color universal design (https://jfly.uni-koeln.de/color).
"""

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, VERMILION, YELLOW, GREY = "#56B4E9", "#D55E00", "#F0E442", "#999999"
INK = "#1d2330"  # of text and of measured curves
_CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, YELLOW, GREY)

Rgb = tuple[int, int, int]


def cycle(index: int) -> str:
  """Returns the colour of the index-th of many things, as "#rrggbb"; it repeats after eight."""
  return _CYCLE[index % len(_CYCLE)]


def rgb(color: str) -> Rgb:
  """Returns red, green and blue (0 to 255) of "#rrggbb"."""
  red, green, blue = bytes.fromhex(color.removeprefix("#"))
  return red, green, blue
