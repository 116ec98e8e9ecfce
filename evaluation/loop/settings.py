"""Settings of a closed loop, and the folder that belongs to one loop alone."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

from nerf2real.core import files
from nerf2real.core.folder_lock import expect_own

_IDENTITY = "loop_settings.json"
TASK = "nerf_nav"
TRAIN, HELD = ("sweep", "slow", "steps"), ("mixed",)  # motions of the stand
AUTO = "auto"  # the teacher is chosen


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopSettings:
  """What is closed, and how much of it."""

  policy: str = ""
  """"shipped", the folder of an exported policy, or "walker"; without one the loop is that of joint
  positions: excite, record, identify, simulate, compare."""
  robot: str = "virtual"
  """Serial port such as /dev/ttyUSB0, or "virtual"."""
  camera: str = "0"
  """A robot's camera: device number, file or URL."""
  offsets: Path | None = None
  """A robot's offset.yaml."""
  lens: Path | None = None
  """Its camera's camera_info YAML: with it the stand is filmed, and the camera identified."""
  hidden: tuple[str, ...] = ()
  """Undeclared effects of the virtual robot: motor_gain@l_knee:0.15, a case such as weak_knee, a
  file with one a line, or "drawn" by the seed; printed at the end alone."""
  seed: int = 1
  """Of the virtual robot: its own build, and what "drawn" draws."""
  reference: Path | None = None
  """Folder with logs of a robot's stand from before; else the virtual robot records its own."""
  scene: Path | None = None
  """Folder of a scene bundle; the built-in room if not given."""
  seconds: float = 12.0
  """Length of a recorded motion [s]."""
  trials: int = 18
  """Trials of the navigation protocol, spread over its 54."""
  simulated: int | None = None
  """Trials in the simulation, spread likewise; as many as on the robot if not given."""
  processes: int = 2
  """Conditions whose trials run side by side, each in a process of its own (a core, 1.5 GB)."""
  time_limit: float | None = None
  """Length of a trial [s]; the task's own if not given."""
  minutes: float = 30.0
  """Time to train the policy on [min]."""
  preset: str = "adapt"
  """Settings of that distillation."""
  teacher: str = AUTO
  """quick, swift, steady, tall, a walker's settings as JSON, the folder of a policy, or auto: the
  walker that succeeds most often with the effects in the simulation, of equal ones the fastest,
  standing taller or fitted to them if all fail."""
  actors: int = 1
  """Collectors of the distillation."""
  out: Path = Path("out/loop")
  """Folder of everything; the same command goes on in it."""


def policy_folder(settings: LoopSettings) -> Path | None:
  """Returns the folder of the policy; None for the scripted walker.

  Raises:
    ValueError: There is none.
  """
  from nerf2real.evaluation.policies import names as policy_names

  if settings.policy in policy_names.WALKERS:
    return None
  return policy_names.policy_folder(settings.policy, task=TASK)


def claim(settings: LoopSettings) -> None:
  """Makes the folder this loop's; trials, minutes and names may change from run to run.

  What is hidden is written as a digest alone until the end.

  Raises:
    ValueError: It is another loop's or holds something else, or a stage would refuse the settings.
  """
  from nerf2real.agents.dmpo.policy.export import read_record

  _check(settings)
  folder = policy_folder(settings) if settings.policy else None
  digest = "" if folder is None else read_record(folder)["sha256"]
  own: dict[str, Any] = {
    "policy": digest or settings.policy,
    "robot": settings.robot,
    "seed": settings.seed,
    "reference": str(settings.reference or ""),
    "hidden": hashlib.sha256(repr(settings.hidden).encode()).hexdigest()[:12],
    "scene": str(settings.scene or ""),
    "seconds": settings.seconds,
    "time_limit": settings.time_limit,
  }
  path = settings.out / _IDENTITY
  expect_own(settings.out, _IDENTITY, of="a loop")
  settings.out.mkdir(parents=True, exist_ok=True)
  if not path.exists():
    files.write_atomically(path, json.dumps(own, indent=1))
    return
  found = json.loads(path.read_text())
  # Loops from before references were noted have none: their folders are taken as they are.
  other = sorted(name for name in own if found.get(name, own[name]) != own[name])
  if other:
    raise ValueError(
      f"{settings.out} holds a loop with another {', '.join(other)}: take another folder with "
      "--out, or the arguments that it began with."
    )


def _check(settings: LoopSettings) -> None:
  """Raises ValueError for what a stage would refuse, hours later."""
  from nerf2real.suite.scene import open_scene

  for name in ("trials", "simulated", "processes", "actors"):
    count = getattr(settings, name)
    if count is not None and count < 1:
      raise ValueError(f"--{name} {count}: expected at least 1.")
  if settings.reference is not None:
    logs = [settings.reference / f"{name}.mcap" for name in TRAIN]
    missing = [str(log) for log in logs if not log.is_file()]
    if missing:
      raise ValueError(f"--reference {settings.reference} lacks {', '.join(missing)}.")
  scene = open_scene(settings.scene)
  if settings.policy:
    from nerf2real.agents.distill.settings import preset
    from nerf2real.agents.distill.teacher import make_teacher

    preset(settings.preset)
    if settings.teacher != AUTO:
      make_teacher(settings.teacher, scene)
