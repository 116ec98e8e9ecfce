"""A head that pans and tilts in a textured box and films it: pictures by cv2.remap, own equations.

Nothing of the analyser is used: rays by OpenCV's undistortion, poses by composed rotations, walls
by the intersection of rays with a box.

Shapes: H height, W width.
"""

import dataclasses
import functools

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.reading import Log, read_log
from nerf2real.core.robot_logs.writer import open_log

START = 1_700_000_000_000_000_000
LENS = Camera(
  width=320, height=240, fx=280, fy=279, cx=162, cy=118, k1=0.05, k2=-0.06, p1=5e-4, p2=-4e-4
)
MODEL = """
<mujoco><worldbody><body pos="0 0 0.4"><joint name="pan" axis="0 0 1" damping=".5" armature=".02"/>
<geom size=".03" mass=".2"/>
<body pos="0 0 0.03"><joint name="tilt" axis="0 1 0" damping=".5" armature=".02"/>
<geom size=".03" mass=".2"/>
<camera name="camera" pos="0.05 0 0.02" xyaxes="0 -1 0 0 0 1"/></body></body></worldbody>
<actuator><position name="pan" joint="pan" kp="20"/><position name="tilt" joint="tilt" kp="20"/>
</actuator></mujoco>"""
_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # head from camera: z ahead, x right
_BOX = np.array([[-2.2, -1.8, -0.6], [2.6, 2.1, 1.9]])  # m, about the head's pan axis at 0.4 m
_TEXELS = 320.0  # a metre


@dataclasses.dataclass(frozen=True)
class Film:
  """What is true of a recording."""

  late: float = 0.0  # s from the light to the stamp
  jitter: float = 0.002  # s, of stamps, standard deviation
  scale: float = 1.0  # true over declared focal length
  gain: float = 1.0
  motion: str = "both"  # "both", "pan" or "still"
  mount: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad
  duration: float = 8.0  # s
  rate: float = 20.0  # Hz
  place: int = 0  # seed of the room's texture
  noise: float = 2.0  # 8-bit levels


@functools.cache
def _walls(seed: int) -> list[np.ndarray]:
  """Returns the looks of six walls, of detail at all scales."""
  rng, walls = np.random.default_rng([seed, 21]), []
  for _ in range(6):
    look = np.full((1600, 1600), 110.0, np.float32)
    for size in (6, 25, 100, 400):
      coarse = rng.normal(0, 24, (size, size)).astype(np.float32)
      look += cv2.resize(coarse, (1600, 1600), interpolation=cv2.INTER_CUBIC)
    walls.append(np.clip(look, 5, 250))
  return walls


def angles(time: np.ndarray, motion: str, seed: int) -> np.ndarray:
  """Returns pan and tilt [T, 2] at times: sums of sines, from rest."""
  rng = np.random.default_rng([seed, 22])
  phase, rate = rng.uniform(0, 2 * np.pi, (2, 2)), rng.uniform(0.2, 0.8, (2, 2))
  ramp = np.clip(time / 1.0, 0, 1)
  ramp = ramp**2 * (3 - 2 * ramp)
  waves = [
    size
    * ramp
    * (
      np.sin(2 * np.pi * rate[i, 0] * time + phase[i, 0])
      + 0.5 * np.sin(2 * np.pi * rate[i, 1] * time + phase[i, 1])
    )
    for i, size in enumerate((0.5, 0.25))
  ]
  both = np.stack(waves, axis=-1)
  return both * {"both": (1, 1), "pan": (1, 0), "still": (0, 0)}[motion]


def _rays(scale: float) -> np.ndarray:
  """Returns the viewing directions [H, W, 3] of the true lens."""
  u, v = np.meshgrid(np.arange(LENS.width), np.arange(LENS.height))
  matrix = np.array(
    [[scale * LENS.fx, 0, LENS.cx - 0.5], [0, scale * LENS.fy, LENS.cy - 0.5], [0, 0, 1]]
  )
  pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
  stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
  plane = cv2.undistortPoints(
    pixels, matrix, np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2]), None, None, None, stop
  )
  return np.dstack([plane.reshape(*u.shape, 2), np.ones(u.shape)])


def picture(film: Film, rays: np.ndarray, pan: float, tilt: float) -> np.ndarray:
  """Returns what the camera sees, float [H, W]."""
  turn = Rotation.from_euler("z", pan) * Rotation.from_euler("y", tilt)
  eye = np.array([0, 0, 0.03]) + turn.apply([0.05, 0, 0.02])
  whole = turn.as_matrix() @ _FORWARD @ Rotation.from_rotvec(film.mount).as_matrix()
  ahead = rays @ whole.T
  ends = np.where(ahead > 0, _BOX[1], _BOX[0])
  reach = (ends - eye) / np.where(np.abs(ahead) < 1e-9, 1e-9, ahead)
  axis = np.argmin(reach, axis=-1)
  hit = eye + ahead * reach.min(axis=-1, keepdims=True) - _BOX[0]
  seen = np.zeros(axis.shape, np.float32)
  ahead_on = np.take_along_axis(ahead, axis[..., None], -1)[..., 0] > 0
  for wall, look in enumerate(_walls(film.place)):
    side = (axis == wall // 2) & (ahead_on == wall % 2)
    if side.any():
      a, b = [i for i in range(3) if i != wall // 2]
      there = [np.flatnonzero(side.any(1 - i)) for i in (0, 1)]
      box = tuple(slice(t[0], t[-1] + 1) for t in there)
      at = hit[box].astype(np.float32) * np.float32(_TEXELS)
      drawn = cv2.remap(
        look, at[..., a], at[..., b], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
      )
      seen[box][side[box]] = drawn[side[box]]
  return seen


def record(path, film: Film, *, seed: int = 0, lens: bool = True, pictures: bool = True) -> Log:
  """Writes a log and reads it back."""
  rng = np.random.default_rng([seed, 23])
  rays = _rays(film.scale)
  at = np.arange(0.0, film.duration, 0.01)
  joints = angles(at - 0.001, film.motion, seed)
  joints = np.round(joints / 0.001534) * 0.001534
  wanted = angles(at + 0.04, film.motion, seed)
  taken = np.arange(0.1, film.duration - 0.1, 1 / film.rate)
  names = ("pan", "tilt")
  with open_log(path) as log:
    for n, t in enumerate(at):
      stamp = START + round(t * 1e9)
      log.write(messages.joint_state(stamp, messages.COMMANDS, names, position=wanted[n]))
      log.write(messages.joint_state(stamp, messages.STATES, names, position=joints[n]))
    if lens:
      log.write(messages.camera_info(START, LENS))
    last = 0.0
    for t in taken if pictures else ():
      pan, tilt = angles(np.array([t]), film.motion, seed)[0]
      seen = picture(film, rays, pan, tilt) * film.gain
      seen = np.clip(np.rint(seen + rng.normal(0, film.noise, seen.shape)), 0, 255)
      jpeg = cv2.imencode(".jpg", seen.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
      last = max(last, t + film.late + rng.normal(0, film.jitter))
      log.write(messages.image(START + round(last * 1e9), jpeg.tobytes()))
  return read_log(path)
