"""What an identification keeps for later: the joints' hypotheses, and what they left of logs."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.files import hash_path
from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.serialization import from_plain, to_plain
from nerf2real.suite.effects.files import from_list, to_list
from nerf2real.sysid.data.opening import load_model
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.limits.supported import on_a_stand
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.model.simulation import Clocks, Member
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.settings import Settings

Array = np.ndarray

_NO_PRIOR = 1e150
"""Stands for an infinite deviation, which JSON has not; its square is finite."""


@dataclasses.dataclass(frozen=True)
class StoredLog:
  """What a hypothesis left of a log."""

  name: str
  fitted: bool
  squares: tuple[float, ...]
  """[B] mean squares of its blocks, rad^2 or m^2."""


@dataclasses.dataclass(frozen=True)
class StoredJoint:
  """A joint's hypothesis and what it left."""

  joint: str
  unit: str
  """rad or m."""
  terms: tuple[Term, ...]
  values: tuple[float, ...]
  follows: bool
  """Whether the simulated state follows the readings."""
  noise: float
  """Of the readings, rad or m."""
  logs: tuple[StoredLog, ...]

  @property
  def split(self) -> list[Array]:
    """The values of each term."""
    return _split(self.terms, np.array(self.values))


@dataclasses.dataclass(frozen=True)
class Stored:
  """A folder that `identify` wrote."""

  content: dict[str, Any]
  """Of report.json."""
  model: mujoco.MjModel
  near: list[Member]
  """The extended model, and others whose fits are near the best."""
  joints: list[StoredJoint]
  not_judged: tuple[str, ...] = ()
  """Joints that have what identification leaves out."""


def remembered(found: Identified, held: Sequence[Log], settings: Settings) -> list[StoredJoint]:
  """Returns what is kept of every joint.

  Args:
    found: what was identified.
    held: logs that were not fitted.
    settings: length of blocks.
  """
  other = Machine(found.model, held, window_s=settings.window_s)
  result = []
  for item in found.joints:
    plants = [item.likelihood.plant, *([other.joint(item.joint)] if held else [])]
    follows, best = item.likelihood.follows, item.extended
    likelihoods = [JointLikelihood(p, settings=settings, follows=follows) for p in plants]
    result.append(joint_of(likelihoods, best.terms, best.fit.x))
  return result


def joint_of(
  likelihoods: Sequence[JointLikelihood], terms: Sequence[Term], x: Array
) -> StoredJoint:
  """Returns what is kept of a joint.

  Args:
    likelihoods: of the logs that were fitted; of those that were not, if any.
    terms: its hypothesis.
    x: values [n].
  """
  first = likelihoods[0]
  logs = tuple(
    StoredLog(log.name, joint is first, tuple(map(float, row)))
    for joint in likelihoods
    for log, row in zip(joint.plant.logs, squares_by_log(joint, terms, x), strict=True)
  )
  return StoredJoint(
    first.plant.joint,
    "rad" if first.plant.hinge else "m",
    tuple(_plain(term, part) for term, part in zip(terms, _split(terms, x), strict=True)),
    tuple(map(float, x)),
    first.follows,
    first.position_noise,
    logs,
  )


def squares_by_log(joint: JointLikelihood, terms: Sequence[Term], x: Array) -> list[Array]:
  """Returns the mean squares [B] of every log's blocks, of positions."""
  squares = joint.squares(joint.residuals(terms, x[None])[0])[0]
  return [squares[joint.log_of == index] for index in range(len(joint.plant.logs))]


def _split(terms: Sequence[Term], x: Array) -> list[Array]:
  """Returns the values of each term."""
  ends = np.cumsum([len(term.names) for term in terms])
  return np.split(np.asarray(x, float), ends[:-1])


def _plain(term: Term, values: Array) -> Term:
  """Returns a term that begins at its values, with numbers that JSON has."""
  prior = tuple(float(np.nan_to_num(sigma, posinf=_NO_PRIOR)) for sigma in term.prior)
  return dataclasses.replace(term, prior=prior, starts=(tuple(map(float, values)),))


def member_to_json(member: Member) -> dict[str, Any]:
  """Returns what is simulated with as details.json has it."""
  clocks = {j: {"skew": c.skew, "latency": c.latency} for j, c in member.clocks.items()}
  return {"extended": to_list(member.effects), "clocks": clocks, "weight": member.weight}


def _member(item: dict[str, Any]) -> Member:
  """Returns what was written by `member_to_json`."""
  clocks = {joint: Clocks(**values) for joint, values in item["clocks"].items()}
  return Member(from_list(item["extended"]), clocks, item.get("weight", 1))


def model_marks(path: Path, compiled: mujoco.MjModel) -> dict[str, Any]:
  """Returns by what a declared model is known again, as details.json has it.

  The compiled model holds what its file includes, and its meshes; the same model compiled by
  another MuJoCo is other bytes, of which the file's own content tells.

  Args:
    path: of the model.
    compiled: the same, as it was read.
  """
  content = np.empty(mujoco.mj_sizeModel(compiled), np.uint8)
  mujoco.mj_saveModel(compiled, None, content)
  return {
    "model_hash": hash_path(path),
    "compiled_hash": hashlib.sha256(content.tobytes()).hexdigest(),
    "compiled_by": mujoco.__version__,
  }


def _is_same(path: Path, compiled: mujoco.MjModel, details: dict[str, Any]) -> bool:
  """Tells whether a model is the one of a stored result; of older ones the file alone is known,
  and of the first ones nothing."""
  now = model_marks(path, compiled)
  whole = details.get("compiled_by") == now["compiled_by"]
  mark = "compiled_hash" if whole else "model_hash"
  return bool(details.get(mark, now[mark]) == now[mark])


def to_json(joints: Sequence[StoredJoint]) -> list[dict[str, Any]]:
  """Returns joints as details.json has them."""
  return [to_plain(joint) for joint in joints]


def read(folder: Path) -> Stored:
  """Returns a result that was written.

  Raises:
    FileNotFoundError: the folder holds none.
    ValueError: its files are not of this version, or the model has changed since.
  """
  folder = Path(folder)
  for name in ("report.json", "details.json"):
    if not (folder / name).is_file():
      raise FileNotFoundError(
        f"Found no {folder / name}, expected a folder that identify.py wrote."
      )
  content = json.loads((folder / "report.json").read_text())
  details = json.loads((folder / "details.json").read_text())
  if "joints" not in details:
    raise ValueError(
      f"Found no joints in {folder / 'details.json'}, expected a result of this version: identify"
      " from the first logs again."
    )
  model = Path(details["model"])
  compiled = load_model(model)
  if not _is_same(model, compiled, details):
    raise ValueError(
      f"Found {model}, or a file that it includes, changed since {folder} was written, expected "
      "the same model: restore it, or identify from the first logs again."
    )
  stand = on_a_stand(model, compiled)
  if details.get("numerics"):
    Numerics(**details["numerics"]).apply(stand)
  return Stored(
    content,
    stand,
    [_member(item) for item in (details, *details.get("near", []))],
    [from_plain(joint, StoredJoint, source=folder / "details.json") for joint in details["joints"]],
    tuple(details.get("not_judged", ())),
  )
