"""Closes the loop: a policy fails on a robot, the data say why, it is trained on and works again.

  python launch/close_loop.py --hidden motor_gain@l_knee:0.15 --policy shipped
  python launch/close_loop.py --hidden drawn --seed 7 --policy runs/walk/policy/newest --trials 54
  python launch/close_loop.py --hidden weak_knee --policy shipped --find-severity --out out/severity
  python launch/close_loop.py --robot virtual --seed 1

Trials on the robot, recordings on a stand, identification, the same trials in the simulation with
what was named, a distillation from the policy, the trials again. What was cut short goes on.
--find-severity makes what is hidden larger until success falls by 30 points, and does no more.
Without --policy joint positions are compared: the robot moves in the air (a sweep, a slow motion
and steps to identify from, another to judge by) and sways on the floor, without and with effects.
"""

import dataclasses
import functools
import sys

from nerf2real.evaluation.loop.settings import LoopSettings
from nerf2real.launch import command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments(LoopSettings):
  """Closes the loop."""

  find_severity: bool = False
  """Only find the size of what is hidden at which success falls by 30 points."""


def run(arguments: Arguments) -> None:
  """Closes the loop and prints what it gave."""
  from nerf2real.core.folder_lock import lock_folder

  with lock_folder(arguments.out, name=".loop.lock"):  # its stages lock folders of their own
    _close(arguments)


def _close(arguments: Arguments) -> None:
  say = functools.partial(print, flush=True)
  if arguments.find_severity:
    from nerf2real.evaluation.loop import severity

    say(severity.as_text(severity.find_severity(arguments, say)))
    return
  if arguments.policy:
    from nerf2real.evaluation.loop import story, telling
    from nerf2real.launch.distill import SCRIPTS

    told = story.close(arguments, SCRIPTS, say)
    telling.write(arguments.out / "loop.html", told)
    say(telling.as_text(told))
    say(f"page: {arguments.out / 'loop.html'}")
    return
  from nerf2real.evaluation.loop.joint_space.closing import close_loop

  closed = close_loop(arguments)
  say(closed.table)
  say(f"report: {closed.report}")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments,
    run,
    environment=command.DRAWING | command.ONE_THREAD,
    errors=(ValueError, OSError, RuntimeError),
    interrupted="stopped: the same command goes on from here",
  )


if __name__ == "__main__":
  sys.exit(main())
