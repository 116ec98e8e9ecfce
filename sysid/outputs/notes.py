"""Sentences of a report that follow from what was found."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.report import summary
from nerf2real.sysid.selection.joints.changed import Changed
from nerf2real.sysid.settings import SETTINGS


def of_one(row: dict[str, Any]) -> str:
  """Returns a sentence on an effect of several joints that may be of one alone."""
  return (
    f"These logs do not tell whether {row['kind']} is of all joints or of {row['joint']} alone,"
    f" which is behind by {row['evidence']['behind_by_standard_errors']:.1f} standard errors."
  )


def growing(found: Sequence[Changed]) -> list[str]:
  """Returns a sentence on what would be named and changes within a log; none where nothing does."""
  grown = [f"{kind} at {item.joint}" for item in found for kind in item.growing]
  if not grown:
    return []
  return [
    f"Not named, as it grows or fades from a log's begin to its end, which that effect does not: "
    f"{', '.join(grown)}."
  ]


def open_loads(effects: Sequence[Mapping[str, Any]]) -> list[str]:
  """Returns a sentence on loads whose mass alone may be nothing; none where there are none.

  Args:
    effects: what is claimed, as the report has it.
  """
  loads = [e for e in effects if e["kind"] == "payload" and "body" in e]
  unsure = [e["body"] for e in loads if e["parameters"]["mass"]["low"] == 0.0]
  if not unsure:
    return []
  return [
    f"Mass and place of the load on {', '.join(unsure)} are open each by itself: what is sure is a "
    f"product of them, what gravity takes of it or what it adds to an inertia."
  ]


def still(joints: Sequence[str]) -> list[str]:
  """Returns a sentence on joints that are commanded and do not move; none where there are none."""
  if not joints:
    return []
  return [
    f"Commanded and not moving in the logs or in the reference, and so not judged: "
    f"{', '.join(joints)}. Command a motion, or look whether they are stuck or switched off."
  ]


def not_judged(beyond: Mapping[str, str]) -> list[str]:
  """Returns a sentence on joints that cannot be simulated alone, and what they have; none where
  there are none."""
  if not beyond:
    return []
  each = ", ".join(f"{name} ({what})" for name, what in beyond.items())
  return [f"Not judged, as the model has there what identification leaves out: {each}."]


def on_stand(*, free: bool) -> list[str]:
  """Returns a sentence on a machine whose base is free in its model; none of one that is fixed."""
  if not free:
    return []
  return [
    "The base is free in the model and held here where the model has it, in the errors, too: the "
    "logs must be of a machine on a stand."
  ]


def unmeasured(model: mujoco.MjModel, logs: Sequence[Log]) -> list[str]:
  """Returns a sentence on joints of the commanded machine that no log has; none without such.

  What has six degrees of freedom is a base, or a body that lies about.
  """
  told = {name for log in logs for name in log.joints}
  commanded = {name for log in logs for name in log.commands.joints}
  trees = {int(model.body_rootid[model.jnt_bodyid[model.joint(name).id]]) for name in commanded}
  names = [
    model.joint(j).name or f"number {j}"
    for j in range(model.njnt)
    if int(model.body_rootid[model.jnt_bodyid[j]]) in trees
    and int(model.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_FREE)
    and model.joint(j).name not in told
  ]
  if not names:
    return []
  return [
    f"In the model and in no log, and so held where the model declares them: {', '.join(names)}. If"
    " they move, what hangs on them moves otherwise than it is simulated, and joints are judged"
    " wrongly: record their positions, or give a model in which they are fixed, if they are."
  ]


def far(error: dict[str, Any]) -> list[str]:
  """Returns a sentence on a remainder that is far above the readings' noise though nothing was
  found; none where it is not.

  Args:
    error: of report.json.
  """
  if not summary.is_far(error):
    return []
  return [
    f"What remains is {summary.times_of_noise(error):.0f} times the readings' noise: that nothing"
    " is named does not mean that the model fits. Look whether it has all that moves, and whether"
    " the logs have units, signs and stamps as expected."
  ]


def long_step(joints: Sequence[Changed]) -> list[str]:
  """Returns a sentence on joints that have something and whose damping the model's step holds
  badly; none without such."""
  shares = {}
  for item in (j for j in joints if j.verdict != "none"):
    plant = item.likelihood.plant
    inertia = float(np.mean([s.inertia.mean() for s in plant.surroundings]))
    inertia += float(plant.declared[INDEX["armature"]])
    shares[item.joint] = abs(plant.numerical_inertia) / inertia
  most = dict(SETTINGS.tolerances)["armature"]
  names = [joint for joint, share in shares.items() if share > most]
  if not names:
    return []
  step = 1e3 * joints[0].likelihood.plant.step
  return [
    f"The model's step of {step:.3g} ms is long for the damping at {', '.join(names)}: that acts as"
    f" inertia which the machine has not, up to {max(shares.values()):.2g} times its own, and as"
    f" {step / 2:.3g} ms of lag. Constants, damping and latencies that are off by as much are the"
    " step's: set a shorter timestep in the model."
  ]


def finer(declared: Numerics, used: Numerics) -> list[str]:
  """Returns a sentence on numerics of a model that show in its readings; none where they do not."""
  if used == declared:
    return []
  shown = [f"its step of {1e3 * declared.step:.3g} ms"] if used.step < declared.step else []
  shown += ["its dry friction, which creeps"] if used.prompt else []
  return [
    f"Of the model's simulation {' and '.join(shown)} would show in readings like these, and no "
    f"machine has that: it was simulated with a step of {1e3 * used.step:.3g} ms"
    f"{' and friction that holds' if used.prompt else ''}, as model_extended.xml is."
  ]


def another_session(item: Changed) -> list[str]:
  """Returns a sentence on what a reference of another session cannot show."""
  if not (item.subject.paired and item.subject.another_session):
    return []
  friction = dict(SETTINGS.another_session)["friction"]
  return [
    f"The reference of {item.joint} is of another session, and a machine's constants differ from"
    f" one to the next (friction by {100 * friction:.0f} %): differences no larger than that makes"
    " are taken for nothing. A reference of the same hour shows smaller ones."
  ]


def supply(logs: Sequence[Log], reference: Sequence[Log]) -> list[str]:
  """Returns a sentence on a supply whose readings differ from a reference's by more than machines'
  strength does within a session; none where either was not measured."""
  volts = [
    [log.battery.value for log in part if log.battery is not None] for part in (logs, reference)
  ]
  if len(volts[0]) < len(logs) or len(volts[1]) < max(1, len(reference)):
    return []
  now, before = (float(np.median(np.concatenate(part))) for part in volts)
  if abs(now / before - 1.0) <= SETTINGS.sigmas * dict(SETTINGS.repeat)["gain"]:
    return []
  return [
    f"The supply's readings are {now:.1f} V in the median, {before:.1f} V in the reference"
    f" ({100 * now / before:.0f} %): what servos give at a duty goes with it."
  ]


def spread(error: dict[str, Any]) -> str:
  """Returns a sentence on the errors of fits near the best."""
  name = "held" if error["held"] else "train"
  found = error[name]
  return (
    f"Errors after are of the mean of {found['models']} fits, weighed by how likely each is. They"
    f" differ: {found['median']:.3g} rad (or m) in the median, {found['least']:.3g} to"
    f" {found['most']:.3g} on the {name} logs; the model that is written alone has"
    f" {found['single']:.3g}."
  )
