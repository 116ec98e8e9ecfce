"""Nightly: a recurrent policy from pictures beats the best memoryless one, over the whole path."""

import numpy as np
import pytest

from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.dmpo.policy.export import load_policy
from nerf2real.agents.environments import cue_task, loading
from tests.agents.processes.test_runs import finish, rows, start

MINUTES = 15
EPISODES = 100
# The best memoryless policy gets 0 on average; 100 episodes of +-22 scatter by 2.2 about it.
MEMORYLESS_BOUND = 4 * cue_task.REWARDED_STEPS / np.sqrt(EPISODES)


@pytest.mark.slow
def test_recurrent_policy_remembers_the_cue(tmp_path):
  run = tmp_path / "run"
  process = start(
    run,
    "--env",
    "agents:cue",
    "--preset",
    "vision_small",
    "--actors",
    "1",
    "--max-env-steps",
    "8000",
    "--evaluation-period",
    "1000",
    "--evaluation-episodes",
    "20",
  )
  finish(process, timeout=MINUTES * 60, run=run)
  exported = load_policy(run / "policy" / "best")
  agent = acting.Agent(exported.policy, exported.layout, seed=0, deterministic=True)
  environment = loading.make_environment(exported.environment, seed=123)
  returns = [acting.run_episode(agent, environment)["return"] for _ in range(EPISODES)]
  curve = [(r["steps"], round(r["return"], 1)) for r in rows(run, "evaluator")]
  assert np.mean(returns) > MEMORYLESS_BOUND, curve
