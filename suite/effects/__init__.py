"""What the nominal model lacks: effects that `sysid` finds and the suite simulates."""

from nerf2real.suite.effects.effect import Effect, Kind, Parameter
from nerf2real.suite.effects.files import read_effects, write_effects
from nerf2real.suite.effects.registry import KINDS, kind_of
from nerf2real.suite.effects.stack import EffectStack

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
