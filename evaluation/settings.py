"""Settings of an evaluation: which policy, on which plant, by which of the paper's protocols."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True)
class EvaluationSettings:
  """What is evaluated, where and how."""

  policy: str = "walker"
  """"walker" (scripted), "shipped", a run's folder, or that of an exported policy."""
  plant: Literal["sim", "virtual", "both", "robot"] = "sim"
  """Where: the training simulation, virtual robots in the true room, both after one another, or a
  robot."""
  protocol: Literal["navigation", "ball", "gain"] = "navigation"
  """Which of the paper's evaluations: tables I, II and V."""
  perturb: Literal["none", "blocked_camera", "moved_object", "person"] = "none"
  """What is disturbed."""
  control: Literal["none", "black", "other_goal"] = "none"
  """What of the observations is falsified, for a control experiment: the pictures are black, or the
  goal is another one than the trial's."""
  swap: tuple[Literal["picture", "lens", "delay", "physics"], ...] = ()
  """Parts of the gap between simulation and virtual robot that are swapped: in the simulation the
  robot's pictures, lens or camera delay; on the virtual robot the simulation's, or the data sheets'
  physics."""
  out: Path = Path("out/evaluation")
  """Folder of the episodes and the report."""
  scene: Path | None = None
  """Folder of a scene bundle; the built-in room if not given."""
  effects: Path | None = None
  """An effects.json for the simulation: what the nominal model lacks."""
  trials: int | None = None
  """Runs so many trials of the protocol, spread over it; all if not given."""
  repetition: int | None = None
  """Runs only this repetition of every start, counted from 0; all if not given."""
  group: str | None = None
  """Runs only this group of the protocol's trials, "center" or "wall" of the ball's; all if not
  given."""
  indices: tuple[int, ...] = ()
  """Runs only these of the protocol's trials, counted from 0; all if not given."""
  processes: int = 1
  """Processes that share the trials in simulation and on virtual robots; each has a plant of its
  own, so that a virtual robot's noise is another than with one."""
  seed: int = 0
  """Seed of the simulation's episodes and of drawn actions."""
  robot_seed: tuple[int, ...] = (1,)
  """Which virtual robots: the seeds of what is hidden in them."""
  placing: tuple[float, float] = (0.03, 0.05)
  """Largest errors of place [m, each axis] and heading [rad] with which a virtual robot is put down
  for repetitions of a navigation trial; the first has none. Chosen: as exactly as a person puts a
  robot on a mark. Without them repetitions on one virtual robot are the same to the bit."""
  stochastic: bool = False
  """Draws actions instead of taking the policy's mean."""
  camera_size: tuple[int, int] | None = None
  """Height and width of a picture that is taken even if the policy does not look at it."""
  robot: str = "/dev/ttyUSB0"
  """Serial port of the robot."""
  camera: str = "0"
  """The robot's camera: device number, file or URL."""
  offsets: Path | None = None
  """The robot's offset.yaml."""
  lens: Path | None = None
  """The camera's camera_info YAML of launch/calibrate_camera.py, for recordings on the robot."""
  record: bool = False
  """Records runs on the virtual robot and the robot as MCAP beside the report."""
  time_limit: float | None = None
  """Length of an episode [s]; the task's own if not given."""
  markdown: Path | None = None
  """Writes the tables of everything in the folder to a Markdown file, too."""
  video: Path | None = None
  """Films the episodes that are run in simulation (.mp4, .webp or .gif)."""
  dry_run: bool = False
  """Robot only: reads everything and puts all questions, moves and keeps nothing; one trial without
  --trials."""
