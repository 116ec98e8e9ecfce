"""What goes together in a residual, against what two recordings of one machine differ by."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from nerf2real.sysid.selection.joints.remainder import structured
from nerf2real.sysid.settings import SETTINGS

LOGS, BLOCKS, SAMPLES = 3, 14, 50
NOISE, WANDERS = 1e-3, 2e-3  # rad


def _accused(amplitudes: np.ndarray, noise: np.ndarray) -> bool:
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
    expectation=None,
  )
  item: Any = SimpleNamespace(fit=SimpleNamespace(residuals=[rows]))
  return structured(joint, item, SETTINGS, WANDERS**2)


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
