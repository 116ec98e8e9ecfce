"""What the figures of an evaluation's report mean: unit, meaning and which values are good."""

from nerf2real.core.pages.blocks import Figure, Figures
from nerf2real.core.pages.page import Section
from nerf2real.evaluation import episodes as kept

FIGURES = (
  Figure("success", None, "%", "share of the trials that reached the goal in time", "higher"),
  Figure("± after a share", None, "%", "standard error over n trials: sqrt(p (1 - p) / (n - 1))"),
  Figure(
    "success, exact 95 % interval",
    None,
    "%",
    "shares that this many successes do not contradict (Clopper and Pearson)",
    "narrow: it narrows with more trials",
  ),
  Figure(
    "time taken",
    None,
    "s",
    "median over the successful trials from start to goal, ± its standard error (bootstrap)",
    "lower",
  ),
  Figure(
    "localization error",
    None,
    "m",
    "median over the trials of the mean distance between the robot and where the policy's belief "
    "expects it; - for a policy without a belief",
    "lower; larger when failed than when successful means that belief decides",
  ),
  Figure(kept.COLLISION, None, "trials", "a part other than the feet touched the room", "0"),
  Figure(kept.FALL, None, "trials", "tilted, low, or on the floor", "0"),
  Figure(kept.LOST, None, "trials", "neither, and not at the goal in time", "0"),
  Figure(kept.STOPPED, None, "trials", "ended by the robot's safety or its operator", "0"),
  Figure("length", None, "s", "from the start to the end of the trial, however it ended"),
  Figure(
    "gain",
    None,
    "",
    "of the camera, as its driver counts; the policy was trained with one",
    "success that does not depend on it",
  ),
)


def section() -> Section:
  """Returns the report's section."""
  text = "Rows marked (paper) are the paper's own figures, of its robot and its rooms."
  return Section("What the figures mean", text, [Figures(FIGURES)])
