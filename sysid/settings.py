"""Constants of the analysis by evidence that adds up (`analysis.py`), all of them chosen.

Most were set on development sets, not calibrated.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Settings:
  """How an identification is done."""

  block_s: float = 1.0
  """s of a block of the likelihood: several times the memory of a servo loop."""
  folds: int = 3
  """Of the cross-validation where there is one log only."""
  window_s: float = 0.5
  """s of the windows that restart from the measured state where an actuator holds no position."""
  effort_scale: float = 2.0
  """Share that a measured effort may be off: torque constants are guesses."""
  effort_repeats: float = 0.03
  """Share by which it differs between two recordings: 15 K change a magnet by 2 to 3 %."""
  duty_scale: float = 0.03
  """Share that full duty may be off the model's torque limit: both are of one data sheet."""
  tolerances: tuple[tuple[str, float], ...] = (
    ("damping", 0.06),
    ("armature", 0.06),
    ("friction", 0.2),
    ("gain", 0.02),
    ("mass", 0.03),
    ("zero", 0.003),
    ("skew", 0.0012),
    ("latency", 0.002),
  )
  """Standard deviations of nominal constants: shares, rad (m), s."""
  servo: float = 0.2
  """Of gain, limit and damping where a reference shows the machine: a model guesses servos, not
  masses."""
  repeat: tuple[tuple[str, float], ...] = (
    ("damping", 0.015),
    ("armature", 0.01),
    ("friction", 0.05),
    ("gain", 0.005),
    ("limit", 0.005),
    ("mass", 0.005),
    ("zero", 0.0007),
    ("skew", 0.0003),
    ("latency", 0.0003),
  )
  """The same between two recordings of one machine in one session."""
  wandering: tuple[str, ...] = ("friction", "latency")
  """Those of them that differ within a recording, too: friction from place to place and with what
  the teeth carry, a command's way with where the firmware's tick is when it comes."""
  another_session: tuple[tuple[str, float], ...] = (
    ("damping", 0.05),
    ("friction", 0.15),
    ("gain", 0.015),
    ("limit", 0.015),
    ("latency", 0.0005),
  )
  """Those that differ by more from one session to another, chosen: 3 K change a grease's viscosity
  by 10 to 20 % and a copper winding by 1.2 %, a supply is set to 1 %, a USB frame lasts 1 ms."""
  repeat_effect: float = 0.05
  """Share by which an effect that a machine always had differs between two recordings."""
  rounds: int = 15
  """Of fitting constants and setting the residual's scale in turn."""
  depth: int = 3
  """Effects of one joint at most."""
  kept: int = 6
  """Hypotheses that are fitted to the end, of those that add one effect to a parent."""
  parents: int = 2
  """Hypotheses that are grown further."""
  worth: float = 2.8
  """Standard errors by which a further effect must be better for the search to go on."""
  reference_depth: int = 1
  """Effects of a joint at most that are looked for in reference logs."""
  structured: float = 0.5
  """Of the readings' noise: a residual that goes together is that large beyond rounding."""
  suspected: float = 1.0
  """Standard errors by which logs of other motions must leave more than references do for effects
  to be tried: a screen that saves time, chosen; blocks of other motions tell little."""
  alike: float = 0.5
  """Of the residual's scale: hypotheses whose predictions differ by less are not told apart."""
  more: float = 2.0
  """Times what the machine leaves anyway: more than that remains to be explained (as a blind set's
  effect counts as seen from twice the healthy machine's error on)."""
  level: float = 0.05
  """Family-wise significance of all names together."""
  sigmas: float = 1.96
  """Standard deviations from a value to the ends of its 95 % interval."""
  saturated: float = 0.98
  """Of the largest duty or effort: what is above has met its limit."""
  settled: float = 0.5
  """Nats that a round of fitting gains at which it ends."""


SETTINGS = Settings()
