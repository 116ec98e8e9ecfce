"""What the nominal model lacks: effects that `sysid` finds and the suite simulates."""

from suite.effects.effect import Effect, Kind, Parameter
from suite.effects.files import read_effects, write_effects
from suite.effects.registry import KINDS, kind_of
from suite.effects.stack import EffectStack

__all__ = [
  "KINDS",
  "Effect",
  "EffectStack",
  "Kind",
  "Parameter",
  "kind_of",
  "read_effects",
  "write_effects",
]
