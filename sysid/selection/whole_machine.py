"""What the whole machine, simulated by MuJoCo, says of what was found joint by joint."""

from collections.abc import Sequence

from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.simulation import error, is_worse
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.settings import Settings


def discard_refuted(found: Identified, settings: Settings) -> None:
  """Claims nothing where all that was found together leaves more than the declared model does.

  Joints are explained one at a time, among others that are prescribed as they were measured. That
  must hold of the same logs where nothing is prescribed. Courses that do not repeat tell nothing.

  Args:
    found: of a machine; changed.
    settings: length of windows where an actuator does not hold its position.
  """

  def left_by(effects: Sequence[Effect]) -> float:
    return error(found.model, found.logs, effects, clocks=found.clocks, window_s=settings.window_s)

  parts = [*found.calibration, *found.objects]
  if not parts or found.followed:
    return
  if not is_worse({"before": left_by([]), "after": left_by(parts)}):
    return
  found.nearest += found.effects
  for rows in (found.calibration, found.objects, found.effects):
    rows.clear()
  for item in found.joints:
    item.elaborated = []
    if item.verdict in ("effects", "partly"):
      item.verdict = "unexplained"
