"""What goes together in a residual, against what two recordings of one machine differ by."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from nerf2real.sysid.fit.expectation import Expectation
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.joints.remainder import structured
from nerf2real.sysid.settings import SETTINGS

LOGS, BLOCKS, SAMPLES = 3, 14, 50
NOISE, WANDERS = 1e-3, 2e-3  # rad


def _accused(
  amplitudes: np.ndarray, noise: np.ndarray, wanders: float = WANDERS, expectation: Any = None
) -> bool:
  """Tells of a course that goes together in blocks, by amplitudes [B], beside noise [N]."""
  waves = np.tile(np.sqrt(2.0) * np.sin(np.linspace(0, 2 * np.pi, SAMPLES)), LOGS * BLOCKS)
  rows = (np.repeat(amplitudes, SAMPLES) * waves + noise)[None]
  log: Any = SimpleNamespace(position=np.round(rows[0] / 1e-5) * 1e-5)
  joint: Any = SimpleNamespace(
    starts=np.arange(LOGS * BLOCKS) * SAMPLES,
    counts=np.full((1, LOGS * BLOCKS), float(SAMPLES)),
    log_of=np.repeat(np.arange(LOGS), BLOCKS),
    plant=SimpleNamespace(logs=[log]),
    position_noise=NOISE,
    expectation=expectation,
    mask=np.ones(LOGS * BLOCKS * SAMPLES),
  )
  item: Any = SimpleNamespace(fit=SimpleNamespace(residuals=[rows]))
  return structured(joint, item, SETTINGS, wanders**2)


def test_a_machine_that_wanders_as_machines_do_is_seldom_accused() -> None:
  random = np.random.default_rng(0)
  accused = 0
  for _ in range(200):
    amplitudes = WANDERS * random.normal(size=LOGS * BLOCKS)
    accused += _accused(amplitudes, NOISE * random.normal(size=LOGS * BLOCKS * SAMPLES))
  assert accused <= 200 * SETTINGS.level


def test_one_that_differs_by_more_in_a_few_blocks_is() -> None:
  random = np.random.default_rng(0)
  amplitudes = np.zeros(LOGS * BLOCKS)
  amplitudes[[3, 20]] = 4.0 * WANDERS
  noise = NOISE * random.normal(size=LOGS * BLOCKS * SAMPLES)
  assert _accused(amplitudes, noise)
  amplitudes[20] = 0.0  # one block may hold a knock
  assert not _accused(amplitudes, noise)


def test_the_noise_of_a_reference_is_no_misfit_of_a_machine() -> None:
  """It is smoothed where it is expected, so that that of neighbours goes together."""
  random, count = np.random.default_rng(0), LOGS * BLOCKS * SAMPLES
  nothing, stamps = np.zeros(LOGS * BLOCKS), np.arange(count, dtype=float)
  log: Any = SimpleNamespace(time=stamps)
  p, accused = np.zeros(len(INDEX)), 0
  for _ in range(200):
    reference = Expectation([log], [(stamps, NOISE * random.normal(size=(1, count)))], p)
    noise = NOISE * random.normal(size=count) - reference.under(p)[0]
    accused += _accused(nothing, noise, 0.0, reference)
  assert accused <= 200 * SETTINGS.level
