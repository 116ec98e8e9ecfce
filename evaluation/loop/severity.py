"""How large an effect must be until a policy's success falls: a table of what it is robust to."""

import dataclasses
from typing import Any

from nerf2real.core import markdown
from nerf2real.core.serialization import to_plain, write_json
from nerf2real.evaluation.episodes import Store
from nerf2real.evaluation.loop import trials
from nerf2real.evaluation.loop.robot import machines
from nerf2real.evaluation.loop.settings import LoopSettings, claim, policy_folder
from nerf2real.evaluation.loop.trials import Condition, Say, Tally, tally
from nerf2real.real.safety.monitor import SafetyError
from nerf2real.suite.scene import open_scene

FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0)
LOSS = 0.3  # of success; chosen: a fall that 54 trials tell from chance


@dataclasses.dataclass(frozen=True)
class Step:
  """The trials at one size."""

  factor: float  # of the sizes that were given; 0: nothing hidden
  effects: tuple[str, ...]
  tally: Tally  # of the trials that began
  ended: str = ""  # why no further trial began


def find_severity(settings: LoopSettings, say: Say) -> list[Step]:
  """Runs the trials with the hidden effects at growing sizes until success falls by `LOSS`, or the
  robot itself gives up: it falls as it stands up, or its own limits switch torque off.

  Writes severity.json.

  Raises:
    ValueError: Nothing is hidden, the robot is a real one, or the settings cannot be run.
  """
  hidden = machines.hidden_effects(settings.hidden, settings.seed)
  if not hidden or settings.robot != "virtual":
    raise ValueError(
      f"Found the robot {settings.robot!r} and {len(hidden)} hidden effects, expected the virtual "
      "robot and at least one: --hidden command_delay:0.02 --find-severity."
    )
  policy = policy_folder(settings)
  claim(settings)
  scene: Any = open_scene(settings.scene)
  store = Store(settings.out)
  steps: list[Step] = []
  for factor in (0.0, *FACTORS):
    altered = tuple(effect.scaled(factor) for effect in hidden) if factor else ()
    name = f"severity {factor:g}"
    condition = Condition(name=name, policy=policy, altered=altered)
    ended = ""
    try:
      found = trials.run(settings, condition, scene, store, say)
    except SafetyError as error:
      if not factor:
        raise
      label, ended = trials.plant_label(settings, condition), str(error)
      found = [e for e in store.episodes if e.setting.plant_id == label]
    step = Step(factor, tuple(str(effect) for effect in altered), tally(name, found), ended)
    steps.append(step)
    say(f"{factor:g} times: {_success(step)}")
    if ended or steps[0].tally.share - step.tally.share >= LOSS:
      break
  write_json(settings.out / "severity.json", [to_plain(step) for step in steps])
  return steps


def _success(step: Step) -> str:
  begun = str(step.tally) if step.tally.trials else "no trial"
  return f"{begun}, then none begins" if step.ended else begun


def as_text(steps: list[Step]) -> str:
  """Returns the steps as a table in Markdown."""
  rows = [
    (
      f"{step.factor:g}",
      ", ".join(step.effects) or "nothing",
      _success(step),
      ", ".join(f"{n} {name}" for name, n in step.tally.outcomes.items() if n),
    )
    for step in steps
  ]
  table = markdown.table(("times", "hidden", "success", "how the trials ended"), rows)
  if steps[-1].ended:
    return f"{table}\n\nThe robot itself gives up at the last size: {steps[-1].ended}\n"
  lost = steps[0].tally.share - steps[-1].tally.share
  end = "falls" if lost >= LOSS else "does not fall"
  return (
    f"{table}\n\nSuccess {end} by {100 * LOSS:.0f} points: by {100 * lost:.0f} at the last size.\n"
  )
