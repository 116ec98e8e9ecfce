"""The virtual robot: a serial port and a camera, behind which there is a body in a true room.

```python
with VirtualRobot(world="room", seed=1, stepped=True) as robot:
  with real.load("nerf_nav", robot=robot.connection()) as environment: ...
```

Everything else here (`place`, `truth`, `faults`, ...) is what a person in the room does and sees;
the host has only the port and the camera.
"""

from typing import Any

import mujoco
import numpy as np

from nerf2real.core.cameras import Camera
from nerf2real.core.rotations import pose_of_mujoco_camera
from nerf2real.real.loading import Connection
from nerf2real.real.loop.clock import Clock, RealClock, SteppedClock
from nerf2real.real.safety.operator import Hand
from nerf2real.real.virtual.body import Body, Truth
from nerf2real.real.virtual.bus.devices import Devices
from nerf2real.real.virtual.bus.faults import Faults
from nerf2real.real.virtual.bus.protocol_rehearsal import Cable
from nerf2real.real.virtual.bus.wire import Wire
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.stream import CameraStream, Sensor
from nerf2real.scenes.builtin.eye import Eye
from nerf2real.suite.op3 import constants

# The lens of the virtual robot's camera: as wide as the C920 of the facts, not quite without
# distortion, its axis not quite in the middle. Ours.
LENS = Camera(
  width=320,
  height=240,
  fx=303.5,
  fy=303.1,
  cx=161.6,
  cy=118.9,
  k1=0.045,
  k2=-0.07,
  p1=0.0004,
  p2=-0.0003,
)
FRAME_RATE = 30.0  # Hz
_SUPERSAMPLE = 1  # 45 dB from 4 x 4 samples at 30x40, and half the time of 2 x 2
_HEAD_CAMERA = "op3/head_camera"


class Eyes:
  """True pictures from the robot's head. One thread uses it: an OpenGL context belongs to one."""

  def __init__(self, body: Body, lens: Camera):
    self._body, self._lens = body, lens
    self._eye: Any = None
    self._data: Any = None

  def picture(self, time: float | None = None) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of now, or of a moment [s] up to 0.6 s ago."""
    model = self._body.model
    if self._eye is None or self._data is None:
      self._eye = Eye(model, groups=(0, 2))  # not the head, inside which the camera is
      self._data = mujoco.MjData(model)
    data = self._data
    data.qpos[:] = self._body.pose_at(self._body.time if time is None else time)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    self._eye.update(data)
    camera = model.camera(_HEAD_CAMERA).id
    pose = pose_of_mujoco_camera(data.cam_xpos[camera], data.cam_xmat[camera])
    return self._eye.render(self._lens, pose, supersample=_SUPERSAMPLE)[0]

  def close(self) -> None:
    """Frees the OpenGL context."""
    if self._eye is not None:
      self._eye.close()
      self._eye = None


class SteppedCamera:
  """The camera of a robot on a `SteppedClock`: the stream's sensor, without a network."""

  def __init__(self, eyes: Eyes, clock: Clock, *, latency: float, sensor: Sensor):
    """Makes the camera; pictures are taken at multiples of the frame's duration."""
    self._eyes, self._clock, self._latency, self.sensor = eyes, clock, latency, sensor
    self._frame, self._picture = -1, np.zeros((1, 1, 3), np.uint8)
    self.frozen = False  # no new pictures come

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture that has arrived, uint8 [H, W, 3], and its age [s]."""
    now = self._clock.now()
    frame = int(np.floor((now - self._latency) * FRAME_RATE + 1e-6))
    if frame != self._frame and not (self.frozen and self._frame >= 0):
      self._frame = frame
      self._picture = self.sensor.develop(self._eyes.picture(frame / FRAME_RATE))
    return self._picture, now - self._frame / FRAME_RATE

  def close(self) -> None:
    """Has nothing to free: the picture belongs to the robot."""


class VirtualRobot:
  """A robot to rehearse with."""

  def __init__(
    self,
    *,
    world: str = "floor",
    seed: int | None = None,
    hidden: Hidden | None = None,
    stepped: bool = False,
    camera: bool = False,
    ball: bool = False,
    lens: Camera = LENS,
    latency: float = 0.04,
    gain: float = 1.0,
    noise: float = 2.0,
    furnish=None,
  ):
    """Builds the robot, hanging in the hand of a person, supply off.

    Args:
      world: "floor", or "room": the built-in room.
      seed: Seed of what is hidden, of noise and of chances; None: as in the data sheets.
      hidden: What is hidden, instead of a draw.
      stepped: Whether time jumps (`SteppedClock`), for rehearsals faster than real time.
      camera: Whether there is a camera (needs EGL).
      ball: Whether there is a ball.
      lens: The camera's lens.
      latency: s from the light to the arrival of a picture.
      gain: Of the camera; 1 is neutral.
      noise: Of the camera [8-bit levels].
      furnish: Called with the world's `mujoco.MjSpec` before the robot is put in, to change it.
    """
    if hidden is None:
      count = len(constants.JOINT_NAMES)
      hidden = Hidden.none(count) if seed is None else Hidden.draw(seed, count)
    self.clock: RealClock | SteppedClock = SteppedClock() if stepped else RealClock()
    self.faults = Faults()
    self.body = Body(world=world, hidden=hidden, ball=ball, furnish=furnish, looks=camera)
    self.body.time = self.clock.now()
    devices = Devices(self.body, faults=self.faults, seed=seed or 0)
    self._wire: Wire | Cable
    if isinstance(self.clock, SteppedClock):
      self._wire = Cable(devices, self.clock)
    else:
      self._wire = Wire(devices, self.clock)
    self.devices = devices
    self.operator = Hand(self.hold)
    self.eyes = Eyes(self.body, lens) if camera else None
    self.camera: SteppedCamera | None = None
    self.stream: CameraStream | None = None
    if self.eyes is not None and stepped:
      sensor = Sensor(gain=gain, exposure=1.0, noise=noise, seed=seed or 0)
      self.camera = SteppedCamera(self.eyes, self.clock, latency=latency, sensor=sensor)
    elif self.eyes is not None:
      self.stream = CameraStream(
        self.eyes.picture, rate_hz=FRAME_RATE, latency_s=latency, gain=gain, noise=noise
      )
      self.stream.start()

  @property
  def port(self) -> str:
    """Name of the serial port: a path, or a URL in stepped time."""
    return self._wire.port

  def connection(self) -> Connection:
    """Returns what `real.load` needs, with this robot's person holding it when asked."""
    source = self.stream.url if self.stream is not None else self.camera
    clock = self.clock if isinstance(self.clock, SteppedClock) else None
    return Connection(port=self.port, camera=source, operator=self.operator, clock=clock)

  # ---- what a person in the room does and sees ----

  def place(self, x: float, y: float, yaw: float) -> None:
    """Lifts the robot and holds it over a place [m] with a heading [rad]."""
    self.body.advance(self.clock.now())
    self.body.place(x, y, yaw)

  def place_ball(self, x: float, y: float) -> None:
    """Puts the ball on the floor at a place [m]."""
    self.body.place_ball(x, y)

  def hold(self, held: bool) -> None:
    """Takes the robot by its torso and lifts it, or lowers it to its feet and lets go."""
    self.body.advance(self.clock.now())
    self.body.hold(held)

  def push(self, force: np.ndarray) -> None:
    """Pushes the torso with a force [3] [N] in the world, until the next call."""
    self.body.advance(self.clock.now())
    self.body.push = np.asarray(force, np.float64)

  def truth(self) -> Truth:
    """Returns what an observer sees now."""
    with self.body.lock:
      self.body.advance(self.clock.now())
      return self.body.truth()

  def close(self) -> None:
    """Switches everything off."""
    self._wire.close()
    if self.stream is not None:
      self.stream.close()
    if self.eyes is not None and self.stream is None:
      self.eyes.close()

  def __enter__(self) -> "VirtualRobot":
    return self

  def __exit__(self, *_: object) -> None:
    self.close()
