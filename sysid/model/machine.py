"""A declared model along several logs: its joints, each reduced along them once."""

from collections.abc import Sequence

import mujoco

from nerf2real.core.robot_logs.reading import Log, moves
from nerf2real.sysid.model.drive import actuator_of
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.reduction import Reduction


class Machine:
  """The joints of a declared model and what several logs hold of them."""

  def __init__(self, model: mujoco.MjModel, logs: Sequence[Log], *, window_s: float = 0.5):
    """Reduces the model along every log.

    Args:
      model: the declared one.
      logs: of the same machine.
      window_s: see `JointModel`.
    """
    self.model, self.logs, self._window_s = model, list(logs), window_s
    self.reductions = [Reduction(model, log) for log in logs]
    self._joints: dict[str, JointModel] = {}

  def moving(self, reference: Sequence[Log] = ()) -> list[str]:
    """Returns the joints with an actuator that all logs command, and that move in them.

    Args:
      reference: further logs, in which they must be commanded and move, too.
    """
    recordings = [part for part in (self.logs, reference) if part]
    return [name for name in self.commanded(reference) if all(moves(p, name) for p in recordings)]

  def commanded(self, reference: Sequence[Log] = ()) -> list[str]:
    """Returns the joints with an actuator that all logs, and those of a reference, command."""
    every = [set(log.commands.joints) for log in (*self.logs, *reference)]
    names = self.logs[0].commands.joints
    return [n for n in names if actuator_of(self.model, n) >= 0 and all(n in e for e in every)]

  def joint(self, name: str) -> JointModel:
    """Returns one of its joints."""
    if name not in self._joints:
      self._joints[name] = JointModel(
        self.model, name, self.logs, reductions=self.reductions, window_s=self._window_s
      )
    return self._joints[name]
