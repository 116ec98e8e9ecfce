"""A task of one's own, registered for `suite.load`, `launch/view.py` and Gymnasium.

  python examples/own_task.py

The OP3 is to stand on one place and look at a goal: reward for facing it, none for walking. From a
package, an entry point of the group `nerf2real.tasks` registers it (see `suite/registry.py`).
"""

import numpy as np

from nerf2real import suite
from nerf2real.suite.tasks import rewards
from nerf2real.suite.tasks.nerf_nav import NerfNav


class FaceGoal(NerfNav):
  """Turn to a goal without leaving the place."""

  time_limit = 10.0  # s
  weights = {"facing": 1.0, "staying": 0.5}  # noqa: RUF012

  def _compute_rewards(self) -> dict[str, float]:
    """Cosine of the goal's bearing, and minus the speed over the floor [m/s]."""
    ahead, left = self.relative(self.goal)[:2]
    terms = {
      "facing": float(ahead / max(np.hypot(ahead, left), 1e-6)),
      "staying": -float(np.hypot(*self.state.velocity[:2])),
    }
    return rewards.combine(terms, self.weights)

  def _reached(self) -> bool:
    ahead, left = self.relative(self.goal)[:2]
    return bool(ahead > 0 and abs(left) < 0.1 * ahead)


suite.register_task("face_goal", FaceGoal)


def main() -> None:
  """Runs a second of it, standing."""
  environment = suite.load("face_goal", image_size=None, random=0)
  environment.reset()
  task = environment.task
  for _ in range(40):
    timestep = environment.step(task.standing_action)
  terms = ", ".join(f"{name} {value:+.2f}" for name, value in task.reward_terms.items())
  print(f"known: {', '.join(suite.known_tasks())}")
  print(f"after {task.outcome.duration:.2f} s: reward {timestep.reward:+.2f} ({terms})")


if __name__ == "__main__":
  main()
