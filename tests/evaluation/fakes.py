"""A plant that plays a script, and episodes made by hand."""

import dm_env
import numpy as np

from nerf2real.evaluation.episodes import Episode, Setting
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.plant import Plant, Sight
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite import specs
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.pose import Pose

FAR = Sight(Pose(0.0, 0.0, 0.0), None, False, False)


class ScriptedPlant(Plant):
  """Shows the sights of a script, one a step; the last step of the script ends the episode."""

  name, plant_id = "sim", "script"

  def __init__(self, script, *, goal=(1.0, 0.0), reason="", image=None, protocol="navigation"):
    super().__init__(EmptyFloor(), EvaluationSettings(protocol=protocol))
    self.script, self._goal, self._reason, self._image = script, np.array(goal), reason, image
    self.started = 0

  @property
  def environment(self):
    return None

  @property
  def goal(self):
    return self._goal

  @property
  def time_limit(self):
    return 30.0

  def _observation(self):
    spec = specs.policy_observation_spec(
      goal_lower=np.full(2, -9.0), goal_upper=np.full(2, 9.0), image_shape=self._image
    )
    rng = np.random.default_rng(self._step)
    found = {name: np.zeros(s.shape, s.dtype) for name, s in spec.items()}
    found["goal"] = self._goal.astype(np.float32)
    if self._image:
      found["camera"] = rng.integers(0, 255, self._image, np.uint8)
    return found

  def start(self, trial):
    self._step = 0
    self.started += 1
    return dm_env.restart(self._observation())

  def step(self, action):
    self._step += 1
    last = self._step >= len(self.script) - 1
    return (dm_env.termination if last else dm_env.transition)(0.0, self._observation())

  def sight(self):
    return self.script[min(self._step, len(self.script) - 1)]

  def stopped(self):
    return self._reason

  def close(self):
    pass


class StillPolicy:
  """Stands; says that it believes to be where it is told."""

  name, policy_id, image_size, control = "still", "0123", None, "none"
  trained_on = ""

  def __init__(self, belief=None):
    self.belief = belief

  def reset(self, sight, *, seed=0):
    pass

  def act(self, observation, *, goal, sight):
    return np.zeros(20, np.float32)


TRIAL = plants.trials("navigation")[0][1]


def episode(outcome="success", *, index=0, group="navigation", **changes):
  setting = {
    "policy": "p",
    "policy_id": "d1",
    "resolution": "30 x 40",
    "plant": "sim",
    "plant_id": "a",
    "protocol": "navigation",
    "perturbation": "none",
    "control": "none",
    "conditions": "",
  }
  fields = {"time": 10.0 if outcome == "success" else None, "duration": 12.0}
  for name, value in changes.items():
    (setting if name in setting else fields)[name] = value
  return Episode(
    setting=Setting(**setting), group=group, index=index, goal=(1.0, 0.0), outcome=outcome, **fields
  )
