"""The virtual robot: a serial port and a camera, behind which there is a body in a true room.

```python
with VirtualRobot(world="room", seed=1, stepped=True) as robot:
  with real.load("nerf_nav", robot=robot.connection()) as environment: ...
```

Everything else here (`place`, `truth`, `faults`, ...) is what a person in the room does and sees;
the host has only the port and the camera.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from nerf2real.real.clock import RealClock, SteppedClock
from nerf2real.real.loading import Connection
from nerf2real.real.safety.operator import Hand
from nerf2real.real.virtual.body import Body, Truth
from nerf2real.real.virtual.bus.devices import Devices
from nerf2real.real.virtual.bus.faults import Faults
from nerf2real.real.virtual.bus.protocol_rehearsal import Cable
from nerf2real.real.virtual.bus.wire import Wire
from nerf2real.real.virtual.camera import Eyes, SteppedCamera, View, VirtualCamera
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.stream import CameraStream
from nerf2real.suite.op3 import constants


class VirtualRobot:
  """A robot to rehearse with."""

  def __init__(
    self,
    *,
    world: str = "floor",
    seed: int | None = None,
    noise: int = 0,
    hidden: Hidden | None = None,
    stepped: bool = False,
    camera: VirtualCamera | None = None,
    ball: bool = False,
    furnish: Callable[[mujoco.MjSpec], None] | None = None,
    view: Callable[[Body], View] | None = None,
  ):
    """Builds the robot, hanging in the hand of a person, supply off.

    Args:
      world: "floor", or "room": the built-in room.
      seed: Seed of what is hidden, of noise and of chances; None: as in the data sheets.
      noise: Another number is another recording of the same robot: other noise, other chances.
      hidden: What is hidden, instead of a draw.
      stepped: Whether time jumps (`SteppedClock`), for rehearsals faster than real time.
      camera: The camera (needs EGL); None: a robot without.
      ball: Whether there is a ball.
      furnish: Called with the world's `mujoco.MjSpec` before the robot is put in, to change it.
      view: Makes the camera's pictures of the body, in place of true ones.
    """
    if hidden is None:
      count = len(constants.JOINT_NAMES)
      hidden = Hidden.none(count) if seed is None else Hidden.draw(seed, count)
    self.clock: RealClock | SteppedClock = SteppedClock() if stepped else RealClock()
    self.faults = Faults()
    looks = camera is not None and view is None
    self.body = Body(world=world, hidden=hidden, ball=ball, furnish=furnish, looks=looks)
    self.body.time = self.clock.now()
    devices = Devices(self.body, faults=self.faults, seed=seed or 0, noise=noise)
    self._wire: Wire | Cable
    if isinstance(self.clock, SteppedClock):
      self._wire = Cable(devices, self.clock)
    else:
      self._wire = Wire(devices, self.clock)
    self.devices = devices
    self.operator = Hand(self.hold)
    self.eyes: View | None = None
    if camera is not None:
      self.eyes = Eyes(self.body, camera.lens) if view is None else view(self.body)
    self.camera: SteppedCamera | None = None
    self.stream: CameraStream | None = None
    if self.eyes is not None and camera is not None:
      if stepped:
        self.camera = SteppedCamera(self.eyes, self.clock, camera, seed=(seed or 0, noise))
      else:
        self.stream = CameraStream(self.eyes.picture, camera, release=self.eyes.close)
        self.stream.start()

  @property
  def port(self) -> str:
    """Name of the serial port: a path, or a URL in stepped time."""
    return self._wire.port

  def connection(self) -> Connection:
    """Returns what `real.load` needs, with this robot's person holding it on demand."""
    source = self.stream.url if self.stream is not None else self.camera
    clock = self.clock if isinstance(self.clock, SteppedClock) else None
    return Connection(port=self.port, camera=source, operator=self.operator, clock=clock)

  def check(self) -> None:
    """Raises RuntimeError, in one line, where the robot in real time answers or sees no more."""
    wire = self._wire if isinstance(self._wire, Wire) else None
    for what, source, lost in (
      ("virtual robot", wire, "its port answers no more"),
      ("virtual robot's camera", self.stream, "no pictures come any more"),
    ):
      error = None if source is None else source.error
      if error is not None:
        raise RuntimeError(
          f"The {what} ended ({type(error).__name__}: {error}): {lost}; start it again."
        ) from error

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

  def turn(self, yaw: float) -> None:
    """Turns the held robot to a heading [rad]."""
    self.body.advance(self.clock.now())
    self.body.turn(yaw)

  def push(self, force: np.ndarray) -> None:
    """Pushes the torso with a force [3] [N] in the world, until the next call."""
    self.body.advance(self.clock.now())
    self.body.push = np.asarray(force, np.float64)

  def truth(self) -> Truth:
    """Returns the observer's present view of the robot."""
    self.check()
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
