"""Every trajectory once: over a line that loses, repeats and reorders, and a learner that dies."""

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
