"""Turns what was drawn for an effect of a blind set into what is applied and written down."""

import numpy as np

from .changes import Parameters


def off_by(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Turns shares by which constants are off into factors."""
  return {name: 1 + value for name, value in drawn.items()}


def one_sided(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Puts the larger friction on either side."""
  if rng.random() < 0.5:
    return {"positive": drawn["negative"], "negative": drawn["positive"]}
  return drawn


def gain(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws what a weaker or stronger gain shows in."""
  weaker = rng.random() < 0.6
  gain = 1 - drawn["change"] if weaker else 1 + drawn["change"]
  return {
    "gain": gain,
    "limit_scales": float(rng.random() < 0.5),
    "effort_sees_it": float(rng.random() < 0.5),
  }


def sag(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Leaves a cause out in two of three draws: load alone, time alone, or both."""
  cause = rng.integers(3)
  return {
    "droop": 0.0 if cause == 1 else drawn["droop"],
    "fade": 0.0 if cause == 0 else drawn["fade"],
  }


def drift(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws whether the clock or its stamps alone drift."""
  return {"rate": drawn["rate"], "stamps_only": float(rng.random() < 0.5)}


def load(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws on which torque the friction depends."""
  return {**drawn, "of_motor": float(rng.random() < 0.5)}


def motor_side(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws on which side of the gap the encoder is."""
  return {"gap": drawn["gap"], "encoder_on_motor": float(rng.random() < 0.3)}


def limit(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Turns a lost share into the limit that is left [N m]."""
  return {"limit": 4.1 * (1 - drawn["lost"])}


def with_seed(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws the seed of the spans."""
  return {**drawn, "seed": float(rng.integers(1 << 30))}


def with_side(rng: np.random.Generator, drawn: Parameters) -> Parameters:
  """Draws the side."""
  return {**drawn, "side": 1.0 if rng.random() < 0.5 else -1.0}
