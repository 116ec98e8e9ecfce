"""What differs from episode to episode: drawn in one place, written to the compiled model.

Paper, section "Reducing the dynamics sim2real gap": random pushes; a constant delay of 10 to 50 ms
an episode and 5 ms jitter on all sensor data; a random mass of up to 0.5 kg at a random place of
the torso; the IMU shifted by up to 0.5 cm and tilted by up to 2 degrees; for the ball, 0.5 to
0.9 kg and 11.5 to 12.5 cm. `draw_episode` is pure: generator in, `EpisodeDraws` out. `Randomiser`
writes them into a compiled MjModel, without recompilation, and restores the nominal values exactly.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.suite.randomisation import inertia
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.light import FIXED, Light, draw_light

Array = np.ndarray

BALL_MASS, BALL_RADIUS = 0.651, 0.12  # kg, m: the real ball, paper
_LONGEST_DELAY = 0.45  # s: the delay lines of IMU and encoders hold 64 samples of 8 ms
_POSITIVE = ("ball_mass_range", "ball_radius_range", "push_interval")
_RANGES = (*_POSITIVE, "delay_range", "push_duration", "push_force")
_LARGEST = ("jitter_half_width", "max_torso_mass", "max_imu_shift", "max_imu_tilt")


@dataclasses.dataclass(frozen=True)
class RandomisationSettings:
  """Switches and ranges. Every switch off gives the nominal episode."""

  pushes: bool = True
  """Push the torso at random times."""
  delays: bool = True
  """Delay sensor data by a constant drawn for each stream and episode."""
  jitter: bool = True
  """Vary the delay from sample to sample."""
  torso_mass: bool = True
  """Attach a random mass to the torso."""
  imu_pose: bool = True
  """Shift and tilt the IMU."""
  ball_mass: bool = True
  """Vary the ball's mass."""
  ball_radius: bool = True
  """Vary the ball's radius."""
  light: bool = False
  """Vary the light on what moves (`sensors.light`). Off unless it is asked for: the pictures of the
  evaluations have one light."""
  delay_range: tuple[float, float] = (filters.MIN_DELAY, filters.MAX_DELAY)
  """s, paper."""
  jitter_half_width: float = filters.JITTER
  """s; uniform within plus and minus this. The paper: "5 ms jitter"; its law is chosen."""
  max_torso_mass: float = 0.5
  """kg, paper; uniform from 0."""
  torso_box_center: tuple[float, float, float] = (-0.01, 0.0, 0.06)
  """m, body frame of the torso; chosen: near the torso's centre of mass."""
  torso_box_half_size: tuple[float, float, float] = (0.05, 0.06, 0.07)
  """m; chosen: about the torso's shell."""
  max_imu_shift: float = 0.005
  """m, paper; uniform in the ball of this radius."""
  max_imu_tilt: float = float(np.deg2rad(2.0))
  """rad, paper; uniform angle about a random axis."""
  ball_mass_range: tuple[float, float] = (0.5, 0.9)
  """kg, paper."""
  ball_radius_range: tuple[float, float] = (0.115, 0.125)
  """m, paper."""
  push_interval: tuple[float, float] = (2.0, 5.0)
  """s between the starts of pushes; no figures in the paper. Chosen: several an episode."""
  push_duration: tuple[float, float] = (0.05, 0.15)
  """s; chosen: shorter than a step of the gait, an impulse."""
  push_force: tuple[float, float] = (5.0, 15.0)
  """N, horizontal; chosen: 0.08 to 0.7 m/s for the 3.2 kg robot if nothing held it."""

  def __post_init__(self):
    for name in _RANGES:
      low, high = getattr(self, name)
      if not (0 <= low <= high < np.inf and (low > 0 or name not in _POSITIVE)):
        least = "above 0" if name in _POSITIVE else "from 0"
        raise ValueError(
          f"The {name} must be two finite numbers {least}, the smaller first, found {low}, {high}."
        )
    for name in _LARGEST:
      if not 0 <= getattr(self, name) < np.inf:
        raise ValueError(f"The {name} must be 0 or more, found {getattr(self, name)}.")
    longest = self.delay_range[1] + self.jitter_half_width
    if longest > _LONGEST_DELAY:
      raise ValueError(
        f"The delay_range with the jitter_half_width ends at {longest:g} s, expected at most "
        f"{_LONGEST_DELAY} s: give both in seconds."
      )


NOMINAL = RandomisationSettings(
  pushes=False,
  delays=False,
  jitter=False,
  torso_mass=False,
  imu_pose=False,
  ball_mass=False,
  ball_radius=False,
)
"""Every switch off: all episodes are the nominal one."""


class Pushes(NamedTuple):
  """Horizontal forces on the torso over an episode, N pushes in order of time."""

  start: Array  # [N], s
  duration: Array  # [N], s
  force: Array  # [N, 2], N, world frame

  def at(self, time: float) -> Array:
    """Returns the force [3] at a time, N in the world frame; zero between pushes."""
    force = np.zeros(3)
    index = int(np.searchsorted(self.start, time + 1e-9)) - 1
    if index >= 0 and time + 1e-9 < self.start[index] + self.duration[index]:
      force[:2] = self.force[index]
    return force


class EpisodeDraws(NamedTuple):
  """The draws of one episode."""

  imu_delay: float  # s
  joint_delay: float  # s
  camera_delay: float  # s
  jitter: float  # half width, s
  torso_mass: float  # kg, added
  torso_mass_position: Array  # [3], m, torso frame
  imu_shift: Array  # [3], m, torso frame
  imu_tilt: Array  # [3], rotation vector, rad, IMU frame
  ball_mass: float  # kg
  ball_radius: float  # m
  pushes: Pushes
  light: Light = FIXED  # on what moves in pictures

  def vector(self) -> Array:
    """Returns the constants of the episode as one array [16], for the critic. Pushes and light
    not."""
    scalars = [self.imu_delay, self.joint_delay, self.camera_delay, self.jitter, self.torso_mass]
    return np.concatenate(
      [
        scalars,
        self.torso_mass_position,
        self.imu_shift,
        self.imu_tilt,
        [self.ball_mass, self.ball_radius],
      ]
    ).astype(np.float64)


NUM_DRAWS = 16


def draw_episode(
  settings: RandomisationSettings,
  rng: np.random.Generator | np.random.RandomState,
  *,
  time_limit: float = 60.0,
) -> EpisodeDraws:
  """Draws one episode.

  The same numbers are taken from the generator whatever the switches, so that turning one
  variation off leaves the others as they were for the same seed; the light alone, drawn last,
  takes none where it is off.
  """
  delays = rng.uniform(*settings.delay_range, size=3) * settings.delays
  mass = rng.uniform(0.0, settings.max_torso_mass) * settings.torso_mass
  half = np.array(settings.torso_box_half_size)
  place = np.array(settings.torso_box_center) + rng.uniform(-1.0, 1.0, size=3) * half
  direction = _unit(rng.normal(size=3))
  shift = direction * settings.max_imu_shift * rng.uniform() ** (1 / 3) * settings.imu_pose
  axis = _unit(rng.normal(size=3))
  tilt = axis * rng.uniform(0.0, settings.max_imu_tilt) * settings.imu_pose
  ball_mass = rng.uniform(*settings.ball_mass_range)
  ball_radius = rng.uniform(*settings.ball_radius_range)
  pushes = _draw_pushes(settings, rng, time_limit)
  if not settings.pushes:
    pushes = Pushes(np.zeros(0), np.zeros(0), np.zeros((0, 2)))
  return EpisodeDraws(
    imu_delay=float(delays[0]),
    joint_delay=float(delays[1]),
    camera_delay=float(delays[2]),
    jitter=settings.jitter_half_width * settings.jitter,
    torso_mass=float(mass),
    torso_mass_position=place * settings.torso_mass,
    imu_shift=shift,
    imu_tilt=tilt,
    ball_mass=float(ball_mass) if settings.ball_mass else BALL_MASS,
    ball_radius=float(ball_radius) if settings.ball_radius else BALL_RADIUS,
    pushes=pushes,
    light=draw_light(rng) if settings.light else FIXED,
  )


def _unit(vector: Array) -> Array:
  return vector / np.linalg.norm(vector)


def _draw_pushes(settings: RandomisationSettings, rng, time_limit: float) -> Pushes:
  count = int(np.ceil(time_limit / settings.push_interval[0])) + 1
  start = np.cumsum(rng.uniform(*settings.push_interval, size=count))
  duration = rng.uniform(*settings.push_duration, size=count)
  strength = rng.uniform(*settings.push_force, size=count)
  angle = rng.uniform(0.0, 2 * np.pi, size=count)
  force = strength[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
  keep = start < time_limit
  return Pushes(start[keep], duration[keep], force[keep])


class Randomiser:
  """Writes an episode's draws into a compiled model, and the nominal values back."""

  def __init__(
    self,
    model: mujoco.MjModel,
    *,
    torso: str | None = None,
    imu_sites: tuple[str, ...] = (),
    ball: str | None = None,
  ):
    """Notes the nominal values of the model as it is now.

    Args:
      model: compiled model. dm_control's `physics.model` is taken too.
      torso: name of the body that carries the extra mass.
      imu_sites: names of the sites that gyroscope and accelerometer sit on.
      ball: name of the ball's geom, a sphere that is the only massive geom of its body.
    """
    self._model = getattr(model, "ptr", model)
    self._scratch = mujoco.MjData(self._model)
    self._torso = self._find(mujoco.mjtObj.mjOBJ_BODY, torso)
    sites = [self._find(mujoco.mjtObj.mjOBJ_SITE, name) for name in imu_sites]
    self._sites = [site for site in sites if site is not None]
    self._ball = self._find(mujoco.mjtObj.mjOBJ_GEOM, ball)
    places = ("site_pos", "site_quat", "site_sameframe", "geom_size", "geom_rbound", "geom_aabb")
    self._nominal = inertia.Snapshot(self._model, (*inertia.MASS_FIELDS, *places))

  def _find(self, kind: mujoco.mjtObj, name: str | None) -> int | None:
    if name is None:
      return None
    index = mujoco.mj_name2id(self._model, kind, name)
    if index < 0:
      noun = kind.name.removeprefix("mjOBJ_").lower()
      count = getattr(self._model, f"n{noun}")
      names = sorted(mujoco.mj_id2name(self._model, kind, i) or "" for i in range(count))
      raise ValueError(f"Found no {noun} named {name!r} in the model, expected one of {names}.")
    return index

  def restore(self) -> None:
    """Writes every nominal value back, bit for bit."""
    self._nominal.restore(self._model)

  def apply(self, draws: EpisodeDraws) -> None:
    """Restores the nominal values, then writes the episode's. Call before data is reset."""
    self.restore()
    model = self._model
    if self._torso is not None:
      inertia.attach_mass(
        model, self._torso, added=draws.torso_mass, position=draws.torso_mass_position
      )
    for site in self._sites:
      self._move_site(site, draws)
    if self._ball is not None:
      self._resize_ball(draws)
    if (self._torso is not None and draws.torso_mass > 0) or self._ball is not None:
      inertia.refresh(model, self._scratch, self._nominal)

  def _move_site(self, site: int, draws: EpisodeDraws) -> None:
    model = self._model
    model.site_pos[site] = self._nominal["site_pos"][site] + draws.imu_shift
    if np.any(draws.imu_tilt):
      nominal = Rotation.from_quat(self._nominal["site_quat"][site], scalar_first=True)
      turned = nominal * Rotation.from_rotvec(draws.imu_tilt)
      model.site_quat[site] = turned.as_quat(scalar_first=True)
    if np.any(draws.imu_tilt) or np.any(draws.imu_shift):
      model.site_sameframe[site] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE

  def _resize_ball(self, draws: EpisodeDraws) -> None:
    model, geom = self._model, self._ball
    body = model.geom_bodyid[geom]
    nominal_mass = self._nominal["body_mass"][body]
    nominal_radius = self._nominal["geom_size"][geom, 0]
    scale = draws.ball_radius / nominal_radius
    # The inertia of a sphere goes with mass times radius squared, hollow or solid.
    model.body_inertia[body] = (
      self._nominal["body_inertia"][body] * (draws.ball_mass / nominal_mass) * scale**2
    )
    model.body_mass[body] = draws.ball_mass
    model.geom_size[geom, 0] = draws.ball_radius
    model.geom_rbound[geom] = draws.ball_radius
    model.geom_aabb[geom, 3:] = draws.ball_radius
    first, count = model.body_bvhadr[body], model.body_bvhnum[body]
    if count == 1:  # the body's bounding volume is its only geom's
      model.bvh_aabb[first, 3:] = draws.ball_radius
