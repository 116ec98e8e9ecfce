"""The rate limiter: exact over any run, no standstill, credits of the dead come back."""

import numpy as np
import pytest

from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter


def _limiter(**changes):
  settings = {
    "steps_per_update": 8.0,
    "min_replay_steps": 100,
    "trajectory_steps": 16,
    "max_steps": 2000,
  }
  names = ("steps", "updates", "refill_until", "unpaid")
  start = {k: changes.pop(k) for k in names if k in changes}
  return RateLimiter(LimiterSettings(**(settings | changes)), **start)


def _simulate(limiter, *, actors, seed, deaths=0.0):
  """Actors with random speeds, episode ends and deaths; a learner that updates now and then."""
  rng = np.random.default_rng(seed)
  held = dict.fromkeys(range(actors), 0)
  for _ in range(200_000):
    if limiter.finished:
      return
    actor = int(rng.integers(actors))
    if rng.random() < deaths:
      limiter.forget(str(actor))
      held[actor] = 0
    if not held[actor]:
      held[actor] = limiter.request(str(actor), 16, held=0)
    elif rng.random() < 0.5:  # a trajectory, cut short by an episode's end at times
      steps = min(held[actor], int(rng.integers(1, 17)))
      limiter.delivered(str(actor), steps)
      held[actor] -= steps
      paid = limiter.unpaid + limiter.updates * limiter.settings.steps_per_update
      paid = max(paid, limiter.refill_until)
      assert limiter.steps - paid <= limiter.lead + 16 * deaths * 1000
    if limiter.update_due and rng.random() < 0.7:
      limiter.updated()
  raise AssertionError(f"Stands still at {limiter.steps} steps, {limiter.updates} updates.")


@pytest.mark.parametrize("actors", [1, 2, 7])
@pytest.mark.parametrize("deaths", [0.0, 0.02])
def test_one_update_for_8_steps_over_a_run(actors, deaths):
  limiter = _limiter()
  _simulate(limiter, actors=actors, seed=actors, deaths=deaths)
  assert limiter.updates == (limiter.steps - 100) // 8
  assert abs(limiter.steps - 2000) <= 20  # 1 %; more only if a dead actor's data still arrives


@pytest.mark.parametrize("rate", [0.5, 3.0, 8.0, 100.0])
def test_other_rates(rate):
  limiter = _limiter(steps_per_update=rate)
  _simulate(limiter, actors=3, seed=0)
  assert limiter.updates == int((limiter.steps - 100) / rate)


def _owed(limiter):
  """Does the updates that are due; returns how many there were."""
  done = 0
  while limiter.update_due:
    limiter.updated()
    done += 1
  return done


def test_updates_after_the_first_fill_follow_the_ratio_without_a_burst():
  limiter = _limiter(min_replay_steps=10_000, max_steps=None)
  limiter.delivered("a", 10_000)
  assert _owed(limiter) == 0  # the fill pays for nothing
  limiter.delivered("a", 7)
  assert _owed(limiter) == 0
  limiter.delivered("a", 1)
  assert _owed(limiter) == 1
  limiter.delivered("a", 47)
  assert _owed(limiter) == 5


def test_a_resumed_run_refills_without_a_burst_and_keeps_its_counts():
  """After 100 steps of filling, 87 updates and 4 steps of the next; the replay is lost."""
  limiter = _limiter(steps=800, updates=87, refill_until=100, unpaid=100)
  limiter.refill(held=0)
  assert (limiter.refill_until, limiter.unpaid) == (900, 200)
  limiter.delivered("a", 99)
  assert not limiter.update_due
  limiter.delivered("a", 1)
  assert _owed(limiter) == 0
  _simulate(limiter, actors=2, seed=1)
  assert limiter.updates == (limiter.steps - 200) // 8


@pytest.mark.parametrize(
  ("steps", "held", "expected"),
  [
    (808, 808, (808, 100)),  # the replay is whole
    (50, 50, (100, 100)),  # stopped in the first fill: it goes on
    (50, 0, (150, 150)),  # and with the replay lost it begins again
    (800, 30, (870, 170)),
  ],
)
def test_what_a_resumed_replay_lacks_is_filled_and_pays_for_nothing(steps, held, expected):
  limiter = _limiter(steps=steps, updates=0, refill_until=100, unpaid=100)
  limiter.refill(held=held)
  assert (limiter.refill_until, limiter.unpaid) == expected


def test_credits_of_a_refused_trajectory_return():
  limiter = _limiter()
  assert limiter.request("a", 16, held=0) == 16
  limiter.returned("a", 16)
  assert (limiter.outstanding, limiter.steps) == (0, 0)


def test_credits_come_whole_and_return():
  limiter = _limiter(min_replay_steps=16, max_steps=None)
  limiter.delivered("a", 16)
  assert [limiter.request("a", 16, held=held) for held in (0, 16, 32, 48, 64)] == [16] * 4 + [0]
  assert limiter.request("a", 8, held=64) == 8  # room for 8 steps, but not for 16
  assert limiter.request("b", 16, held=0) == 16  # another actor makes more room
  limiter.forget("a")
  assert limiter.outstanding == 16


def test_a_lost_answer_is_not_counted_twice():
  limiter = _limiter()
  assert limiter.request("a", 16, held=0) == 16  # the answer never arrives
  assert limiter.request("a", 16, held=0) == 16
  assert limiter.outstanding == 16


def test_the_end_is_exact():
  limiter = _limiter(max_steps=40, min_replay_steps=10)
  assert limiter.request("a", 16, held=0) == 16
  assert limiter.request("b", 16, held=0) == 16
  assert limiter.request("c", 16, held=0) == 8
  assert limiter.ending and limiter.request("d", 16, held=0) == 0


def test_updates_without_payment_ask_for_no_steps_and_give_no_credits():
  free, paid = _limiter(steps=100), _limiter(steps=100)
  for _ in range(50):
    free.updated(paid=False)
  assert free.updates == 50 and free.limit == paid.limit and not free.update_due
  for limiter in (free, paid):
    limiter.delivered("0", 8)
    assert limiter.update_due
    limiter.updated()
    assert not limiter.update_due
  assert free.limit == paid.limit
