"""A learner without networks, as a process: the link, the limiter and a replay on disk.

python mini_learner.py ENDPOINT FOLDER LEASE [USERS]; prints "ready" when it listens. With "join" as
a further argument it joins the router at ENDPOINT, and USERS is its own login.
"""

import sys
import time
from pathlib import Path

import numpy as np

from nerf2real.agents.dmpo.replay.ring import Field, Replay, check_trajectory
from nerf2real.agents.link import sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink

FIELDS = {"reward": Field((), "float32"), "image": Field((30, 40, 3), "uint8")}
LENGTH = 48


def make_trajectory(mark: int, steps: int = LENGTH) -> dict[str, np.ndarray]:
  """A trajectory of about 170 KB that can be recognised."""
  image = np.full((steps, 30, 40, 3), mark % 256, np.uint8)
  return {"reward": np.full(steps, mark, np.float32), "image": image}


def main() -> None:
  endpoint, folder, lease = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])
  users = Path(sys.argv[4]) if len(sys.argv) > 4 else None
  join = sys.argv[-1] == "join"
  security = sessions.Security(login=users) if join else sessions.Security(users=users)
  settings = sessions.LinkSettings(lease=lease, security=security)
  replay = Replay(FIELDS, length=LENGTH, capacity_steps=1000 * (LENGTH - 1), folder=folder)
  steps = replay.steps
  limiter = RateLimiter(
    LimiterSettings(steps_per_update=8.0, min_replay_steps=1, trajectory_steps=LENGTH - 1),
    steps=steps,
    updates=steps // 8,
    refill_until=0,
    unpaid=0,
  )

  def insert(trajectory, actor: int, number: int) -> int:
    size = check_trajectory(trajectory, FIELDS, length=LENGTH)
    replay.insert(trajectory, actor=actor, number=number)
    return size - 1

  session = (
    sessions.connect(endpoint, settings, timeout=30)
    if join
    else sessions.listen(endpoint, settings)
  )
  link = LearnerLink(
    session, settings, limiter=limiter, insert=insert, description={}, known=replay.origins()
  )
  link.publish_parameters({"w": np.full(3, 7, np.float32)}, version=1)
  print("ready", flush=True)
  while True:
    with link.lock:
      while limiter.update_due:
        limiter.updated()
      status = {"steps": limiter.steps, "updates": limiter.updates}
    link.set_status(status | {"alive": link.alive()})
    time.sleep(0.005)


if __name__ == "__main__":
  main()
