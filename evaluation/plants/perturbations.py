"""The paper's perturbed settings: a blocked camera, a moved object, a person walking around.

Each is the same in simulation and around the virtual robot: bodies that are in no plan are put
into the model before it is compiled and moved as time goes on; the camera sees them and the robot
collides with them. For the robot they are instructions to the operator.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from nerf2real.core.geometry.rotations import yaw_quaternion
from nerf2real.suite.op3 import constants

NONE, BLOCKED_CAMERA, MOVED_OBJECT, PERSON = "none", "blocked_camera", "moved_object", "person"
PERTURBATIONS = (NONE, BLOCKED_CAMERA, MOVED_OBJECT, PERSON)
BLOCKED = (3.0, 6.0)  # s of an episode without a picture; chosen: while the robot is on its way
PERSON_SPEED = 0.4  # m/s; chosen: a slow walk
_CLEAR = 0.5  # m between a moved object and starts and goals; chosen: room to turn the robot
_GRID = 0.1  # m between the places that are looked at
_PREFIX = "perturbation"
ROBOT_PREFIX = "op3/"  # of the robot's geoms, in simulation and in the virtual robot's world
_WOOD, _CLOTH, _SKIN = (0.45, 0.30, 0.18, 1.0), (0.20, 0.28, 0.45, 1.0), (0.80, 0.60, 0.48, 1.0)

# What the operator of a robot does, each episode.
INSTRUCTIONS = {
  BLOCKED_CAMERA: f"Cover the camera from second {BLOCKED[0]:g} to second {BLOCKED[1]:g}.",
  MOVED_OBJECT: "Move a chair to another place of the room before the episode.",
  PERSON: "Walk slowly around in the room during the episode.",
}


class Part(NamedTuple):
  """A geom of a body that is put into the world."""

  kind: str  # "box" or "capsule"
  size: tuple[float, ...]  # half sizes, or radius and half length [m]
  position: tuple[float, float, float]  # m in the body
  color: tuple[float, float, float, float]


# A stool: seat and four legs. A person's legs and trunk, as high as the robot's camera may see.
_STOOL = (
  Part("box", (0.17, 0.17, 0.02), (0, 0, 0.43), _WOOD),
  *(
    Part("box", (0.02, 0.02, 0.2), (x, y, 0.21), _WOOD)
    for x in (-0.14, 0.14)
    for y in (-0.14, 0.14)
  ),
)
# The legs end above the floor: a body that nothing holds must not lean on it.
_PERSON = (
  Part("capsule", (0.06, 0.34), (0.0, 0.1, 0.42), _CLOTH),
  Part("capsule", (0.06, 0.34), (0.0, -0.1, 0.42), _CLOTH),
  Part("capsule", (0.15, 0.28), (0.0, 0.0, 1.15), _SKIN),
)


class Intruder:
  """A body in the world that is in no plan."""

  def __init__(self, parts: tuple[Part, ...], path: np.ndarray, *, speed: float):
    """Creates the body.

    Args:
      parts: Its geoms.
      path: Places [N, 2] that it walks along, back and forth; one place: it stands there [m].
      speed: m/s.
    """
    self.parts, self._path, self._speed = parts, np.atleast_2d(path), speed
    legs = np.linalg.norm(np.diff(self._path, axis=0), axis=1)
    self._marks = np.concatenate([[0.0], np.cumsum(legs)])
    self._geoms, self._robot = np.zeros(0, int), np.zeros(0, int)
    self._mocap = -1

  def place(self, time: float) -> tuple[np.ndarray, float]:
    """Returns where it is [2] [m] and its heading [rad] at a time of the episode [s]."""
    length = self._marks[-1]
    if length == 0:
      return self._path[0].copy(), 0.0
    along = (time * self._speed) % (2 * length)
    back = along > length
    along = 2 * length - along if back else along
    leg = min(int(np.searchsorted(self._marks, along, side="right")) - 1, len(self._path) - 2)
    share = (along - self._marks[leg]) / max(self._marks[leg + 1] - self._marks[leg], 1e-9)
    step = self._path[leg + 1] - self._path[leg]
    heading = float(np.arctan2(step[1], step[0]) + np.pi * back)
    return self._path[leg] + share * step, heading

  def add_to_spec(self, spec: mujoco.MjSpec) -> None:
    """Puts it into a world before that is compiled (the virtual robot's)."""
    body = spec.worldbody.add_body(name=_PREFIX, mocap=True, pos=[*self._path[0], 0.0])
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE}
    for index, part in enumerate(self.parts):
      body.add_geom(
        name=f"{_PREFIX}_{index}",
        type=kinds[part.kind],
        size=[*part.size, 0, 0][:3],
        pos=list(part.position),
        rgba=list(part.color),
        group=0,
      )

  def add_to_arena(self, root: Any) -> None:
    """Puts it into an arena's model before that is compiled (the simulation's)."""
    body = root.worldbody.add("body", name=_PREFIX, mocap=True, pos=(*self._path[0], 0.0))
    for index, part in enumerate(self.parts):
      body.add(
        "geom",
        name=f"{_PREFIX}_{index}",
        type=part.kind,
        size=part.size,
        pos=part.position,
        rgba=part.color,
        group=0,
      )

  def bind(self, model: mujoco.MjModel) -> None:
    """Finds itself in the compiled model."""
    names = [model.geom(index).name for index in range(model.ngeom)]
    self._geoms = np.flatnonzero([name.startswith(f"{_PREFIX}_") for name in names])
    feet = tuple(ROBOT_PREFIX + link for link in constants.FOOT_LINKS)
    self._robot = np.flatnonzero(
      [name.startswith(ROBOT_PREFIX) and not name.startswith(feet) for name in names]
    )
    self._mocap = int(model.body(_PREFIX).mocapid[0])

  def move(self, data: mujoco.MjData, time: float) -> None:
    """Puts it where it is at a time of the episode [s]."""
    place, heading = self.place(time)
    data.mocap_pos[self._mocap] = (*place, 0.0)
    data.mocap_quat[self._mocap] = yaw_quaternion(heading)

  def touched(self, data: mujoco.MjData) -> bool:
    """Returns whether a part of the robot other than the feet touches it now."""
    if not data.ncon:
      return False
    pairs = data.contact.geom
    hit = np.isin(pairs, self._geoms).any(axis=1) & np.isin(pairs, self._robot).any(axis=1)
    return bool(hit.any())


def make_intruder(perturbation: str, scene: Any, *, keep_clear: np.ndarray) -> Intruder | None:
  """Returns the body that a perturbation puts into a scene, if any.

  Args:
    perturbation: One of PERTURBATIONS.
    scene: The bundle, for its extent and free space.
    keep_clear: Starts and goals [N, 2] that it must not stand on [m].

  Raises:
    ValueError: Unknown, or there is no room for it.
  """
  if perturbation not in PERTURBATIONS:
    raise ValueError(f"Unknown perturbation {perturbation!r}: expected one of {PERTURBATIONS}.")
  if perturbation in (NONE, BLOCKED_CAMERA):
    return None
  floor = scene.free_space.grid(scene.extent, _GRID)
  points, clearance = floor.centres[floor.free], floor.clearance[floor.free]
  away = (
    np.linalg.norm(points[:, None] - keep_clear, axis=-1).min(axis=1) if len(keep_clear) else 9.0
  )
  fit = np.where(np.asarray(away) > _CLEAR, clearance, 0.0)
  if fit.max() <= 0:
    raise ValueError(
      f"Found no free place {_CLEAR:g} m from every start and goal for {perturbation!r}: use a "
      "larger scene."
    )
  middle = points[int(np.argmax(fit))]
  if perturbation == MOVED_OBJECT:
    return Intruder(_STOOL, middle, speed=0.0)
  # The person crosses the room through that place along the longer free direction.
  free = {tuple(np.round(point, 3)) for point in points[away > _CLEAR]}
  lines = []
  for direction in ((_GRID, 0.0), (0.0, _GRID)):
    ends = []
    for sign in (-1, 1):
      end = middle
      while tuple(np.round(end + sign * np.array(direction), 3)) in free:
        end = end + sign * np.array(direction)
      ends.append(end)
    lines.append(np.array(ends))
  return Intruder(
    _PERSON, max(lines, key=lambda line: float(np.ptp(line, axis=0).max())), speed=PERSON_SPEED
  )


def is_blocked(perturbation: str, time: float) -> bool:
  """Returns whether the camera is covered at a time of the episode [s]."""
  return perturbation == BLOCKED_CAMERA and BLOCKED[0] <= time < BLOCKED[1]
