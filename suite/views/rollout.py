"""Episodes of a task as a video: third person, the robot's view, the map with a trail."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from rich.progress import track

from nerf2real import suite
from nerf2real.core import files
from nerf2real.suite.op3 import constants
from nerf2real.suite.views.overview import TopDown
from nerf2real.suite.views.third_person import ThirdPerson

_HEIGHT, _WIDTH = 360, 480  # pixels of the third person's picture and of the enlarged robot's view
_FRAME_STEPS = 2  # control steps between frames: 20 frames/s
_INK, _PAPER = (29, 35, 48), (255, 255, 255)
_STRIP = 44  # pixels of text under the pictures


def make_policy(name: str, standing: np.ndarray, seed: int) -> Callable[[], np.ndarray]:
  """Returns a function that gives the next action."""
  rng = np.random.default_rng(seed)
  if name == "stand":
    return lambda: standing
  return lambda: np.clip(standing + rng.normal(0, 0.5, standing.shape), -1, 1).astype(np.float32)


def compose(pictures: list[np.ndarray], text: str) -> np.ndarray:
  """Returns the pictures side by side above a line of text; width and height are even."""
  row = np.hstack(pictures)
  strip = np.full((_STRIP, row.shape[1], 3), _PAPER, np.uint8)
  cv2.putText(strip, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.52, _INK, 1, cv2.LINE_AA)
  frame = np.vstack([row, strip])
  return np.ascontiguousarray(frame[:, : frame.shape[1] // 2 * 2])


class Video:
  """An H.264 file that grows frame by frame."""

  def __init__(self, path: Path):
    rate = Fraction(1 / (constants.CONTROL_TIMESTEP * _FRAME_STEPS)).limit_denominator(1000)
    self._container = av.open(str(path), "w")
    self._stream = self._container.add_stream("libx264", rate=rate, options={"crf": "23"})
    self._stream.pix_fmt = "yuv420p"

  def add(self, frame: np.ndarray) -> None:
    """Adds a frame, RGB uint8 [H, W, 3]."""
    if not self._stream.codec_context.is_open:
      self._stream.height, self._stream.width = frame.shape[:2]
    for packet in self._stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")):
      self._container.mux(packet)

  def close(self) -> None:
    """Writes what is left."""
    for packet in self._stream.encode():
      self._container.mux(packet)
    self._container.close()


@contextlib.contextmanager
def open_video(path: Path) -> Iterator[Video]:
  """Opens a video for writing, its folder is made; the file appears, whole, at the context's end.

  What was filmed until Ctrl-C is kept, too: a video that plays.
  """
  path.parent.mkdir(parents=True, exist_ok=True)
  interrupt: KeyboardInterrupt | None = None
  with files.atomic_path(path) as partial:
    film = Video(partial)
    try:
      yield film
    except KeyboardInterrupt as error:
      interrupt = error
    film.close()
  if interrupt is not None:
    raise interrupt


def describe(task_name: str, environment: suite.environment.Environment) -> str:
  """Returns the line of text under a frame."""
  task = environment.task
  terms = "  ".join(f"{name} {value:+.2f}" for name, value in task.reward_terms.items())
  return f"{task_name}  {task.outcome.duration:5.2f} s   {terms}"


def run_episodes(
  task_name: str = "nerf_nav",
  *,
  scene: Path | None = None,
  effects: Path | None = None,
  policy: str = "stand",
  seconds: float = 10.0,
  image_height: int = 60,
  seed: int = 0,
  video: Path | None = None,
) -> list[str]:
  """Runs episodes; returns a line for each that ended.

  Args:
    task_name: Task.
    scene: Folder of a scene bundle; None is the built-in room.
    effects: An effects.json: what the nominal model lacks.
    policy: "stand" holds the reference pose, "random" moves randomly about it.
    seconds: Length of the run, over as many episodes as it takes.
    image_height: Height of the robot's picture [pixel]; its width is 4/3 of it.
    seed: Of the episodes.
    video: Where to write a video (.mp4); None writes none.
  """
  environment = suite.load(
    task_name,
    scene=scene,
    effects=effects,
    random=seed,
    image_size=(image_height, image_height * 4 // 3),
  )
  timestep = environment.reset()
  task = environment.task
  act = make_policy(policy, task.standing_action, seed)
  if video is None:
    return _run_steps(task_name, seconds, environment, timestep, act, None, None)
  third = ThirdPerson(task, environment.physics, height=_HEIGHT, width=_WIDTH)
  with open_video(video) as film:
    views = (third, TopDown(task, _HEIGHT))
    return _run_steps(task_name, seconds, environment, timestep, act, views, film)


def _run_steps(
  task_name: str,
  seconds: float,
  environment: suite.environment.Environment,
  timestep: Any,
  act: Callable[[], np.ndarray],
  views: tuple[ThirdPerson, TopDown] | None,
  film: Video | None,
) -> list[str]:
  task = environment.task
  lines = []
  steps = round(seconds / constants.CONTROL_TIMESTEP)
  for step in track(range(steps), description=task_name, disable=not sys.stderr.isatty()):
    if timestep.first() and views is not None:
      for view in views:
        view.restart()
    timestep = environment.step(act())
    if timestep.last():
      outcome = task.outcome
      ending = outcome.ending or "time limit"
      success = f"success after {outcome.success_time:.2f} s" if outcome.success else "no success"
      lines.append(f"episode of {outcome.duration:.2f} s: {success}, ended by {ending}")
    if views is not None and film is not None and step % _FRAME_STEPS == 0:
      own = cv2.resize(
        timestep.observation["camera"], (_WIDTH, _HEIGHT), interpolation=cv2.INTER_NEAREST
      )
      pictures = [views[0].draw(), own, views[1].draw()]
      film.add(compose(pictures, describe(task_name, environment)))
  return lines
