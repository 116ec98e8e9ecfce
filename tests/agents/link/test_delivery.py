"""Every trajectory once: over a line that loses, repeats and reorders, and a learner that dies."""

import time

import numpy as np

from nerf2real.agents.link.delivery import Ledger, Outbox


def test_exactly_once_over_a_bad_line():
  rng = np.random.default_rng(0)
  outbox, ledger, inserted = Outbox(resend_after=1.0), Ledger(), []
  now, line = 0.0, []
  made = 0
  while made < 200 or outbox.size:
    now += 0.1
    if made < 200 and rng.random() < 0.5:
      made += 1
      outbox.add(str(outbox.made + 1).encode(), steps=3)
    for pending in outbox.due(now):
      if rng.random() < 0.7:  # the rest is lost
        line.append(pending.payload)
    rng.shuffle(line)
    for payload in line[: len(line) // 2]:
      number = int(payload)
      if not ledger.seen(7, number):
        ledger.record(7, number)
        inserted.append(number)
    del line[: len(line) // 2]
    if rng.random() < 0.05:  # a new learner: what was on the line is gone, the replay is not
      ledger, line = Ledger(), []
      for number in inserted[-100:]:  # but for its oldest entries
        ledger.record(7, number)
    if rng.random() < 0.3:
      ledger.confirm(7, oldest=outbox.oldest)
      outbox.acknowledge(ledger.acknowledged(7))
  assert sorted(inserted) == list(range(1, 201))
  assert outbox.resent > 0 and ledger.gaps(7) == 0


def test_a_gap_is_seen_and_holds_back_the_acknowledgement():
  ledger = Ledger()
  for number in (1, 2, 5, 6):
    ledger.record(3, number)
  assert (ledger.acknowledged(3), ledger.gaps(3)) == (2, 2)
  ledger.record(3, 3)
  ledger.record(3, 4)
  assert (ledger.acknowledged(3), ledger.gaps(3)) == (6, 0)


def test_a_learner_without_memory_trusts_what_was_acknowledged_before():
  ledger = Ledger()
  ledger.record(3, 41)
  ledger.confirm(3, oldest=40)
  assert (ledger.acknowledged(3), ledger.gaps(3)) == (39, 1)


def test_many_that_wait_for_their_predecessors_are_recorded_in_little_time():
  ledger, count = Ledger(), 30_000
  begin = time.perf_counter()
  for number in range(2, count + 2):  # the first one is lost, as the replay of a resumed run has it
    ledger.record(1, number)
  assert time.perf_counter() - begin < 5.0  # hundredths; not with the square of their number
  assert ledger.acknowledged(1) == 0 and ledger.gaps(1) == 1
  ledger.record(1, 1)
  assert ledger.acknowledged(1) == count + 1 and ledger.gaps(1) == 0


def test_a_word_about_numbers_far_ahead_is_taken_at_once():
  ledger = Ledger()
  for number in (3, 4, 9):
    ledger.record(1, number)
  ledger.confirm(1, oldest=4)
  assert ledger.acknowledged(1) == 4 and ledger.gaps(1) == 4
  assert ledger.seen(1, 9) and not ledger.seen(1, 5)
  ledger.confirm(1, oldest=2**62)
  assert ledger.acknowledged(1) == 2**62 - 1 and ledger.gaps(1) == 0


def test_outbox_sends_once_until_the_time_is_over():
  outbox = Outbox(resend_after=5.0)
  outbox.add(b"a", steps=4)
  assert [p.payload for p in outbox.due(0.0)] == [b"a"]
  assert outbox.due(4.9) == []
  outbox.add(b"b", steps=2)
  assert [p.payload for p in outbox.due(5.1)] == [b"a", b"b"]
  assert (outbox.steps, outbox.resent) == (6, 1)
  outbox.acknowledge(1)
  assert (outbox.steps, outbox.oldest) == (2, 2)
  outbox.forget_sent()
  assert [p.payload for p in outbox.due(5.2)] == [b"b"]
