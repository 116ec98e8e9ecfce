"""What the figures of an identification's report mean: unit, meaning and which values are good."""

from nerf2real.core.pages.blocks import Figure, Figures
from nerf2real.core.pages.page import Section

FIGURES = (
  Figure(
    "declared, extended",
    None,
    "mrad or mm",
    "RMSE of the simulated position against the measured one, with the declared model and with the "
    "effects found",
    "extended lower than declared, and near the noise of the readings",
  ),
  Figure(
    "noise of the readings",
    None,
    "mrad or mm",
    "standard deviation of a reading: no model can be nearer than this",
  ),
  Figure("lower by", None, "times", "declared over extended error", "above 1; 1 gains nothing"),
  Figure(
    "value, 95 % interval",
    None,
    "in the table",
    "an effect's parameter, and the values that the logs do not contradict",
    "an interval that is narrow beside the value and holds no zero",
  ),
  Figure(
    "gain",
    None,
    "nats",
    "how much more likely left-out blocks are than with the constants alone",
    "higher; a name needs all that lack it to be clearly behind",
  ),
  Figure(
    "behind", None, "standard errors", "difference of gains over its standard error", "above 3"
  ),
  Figure(
    "left", None, "mrad or mm", "of positions, in the median left-out block", "near the noise"
  ),
  Figure(
    "constants off by", None, "%", "fitted over declared value of a nominal constant", "near 0"
  ),
  Figure(
    "reading late, command late",
    None,
    "ms",
    "latency that is taken for the machine's own and not for an effect",
    "near what the machine's bus needs",
  ),
  Figure(
    "share of the square",
    None,
    "%",
    "of the squared residual that lies in the fifth of the samples that holds most of it",
    "20: spread evenly; 100: all of it sits there",
  ),
  Figure(
    "with (chance)",
    None,
    "",
    "probability of as large a correlation of residual and quantity by chance",
    "not small: nothing is left that goes with it",
  ),
  Figure("gaps, stamps that repeat", None, "readings", "of a log, see The logs", "0"),
  Figure(
    "stale share", None, "share", "readings that repeat the last one while a joint moves", "near 0"
  ),
  Figure("saturated share", None, "share", "readings of effort at the log's highest", "near 0"),
  Figure(
    "clock drift, recorder drift",
    None,
    "s/s",
    "slope of the recorder's time over the stamps, less one",
    "near 0",
  ),
  Figure(
    "separation",
    None,
    "noise of the sensor",
    "how far the remaining hypotheses' predictions differ under a motion",
    "higher: that motion tells them apart",
  ),
)


def section() -> Section:
  """Returns the report's section."""
  return Section("What the figures mean", "", [Figures(FIGURES)])
