"""Kinds that are a force over a joint's position and velocity, each in one file.

Such a kind is its law and its parameters with their ranges; the suite's operator, the analyser's
simulation, its search and its report take it from there:

    @laws.law
    def cushion(position: float, velocity: float, stiffness: float, place: float) -> float:
      return -stiffness * max(position - place, 0.0)

    KINDS = (force_kind("cushion", "a spring beyond a place", cushion, (Parameter(...), ...)),)

and a line in `registry.py`. The law must be smooth over a fiftieth of the joint's range, as the
analyser tabulates it; dry friction is none of these.
"""

from collections.abc import Callable, Sequence

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Kind, Operator, Parameter
from nerf2real.suite.effects.kinds import laws


class ForceLaw(Operator):
  """Adds the force of its kind's law."""

  def bind(self, binding: Binding) -> None:
    parameters = self.per_joint(binding)
    self._law = laws.over(self.kind.law)
    self._values = tuple(parameters[p.name] for p in self.kind.parameters)

  def step(self, binding: Binding) -> None:
    binding.force += self._law(binding.position, binding.velocity, *self._values)


def force_kind(name: str, summary: str, law: Callable, parameters: Sequence[Parameter]) -> Kind:
  """Returns a kind that is a force.

  Args:
    name: of the kind.
    summary: in some words.
    law: of (position, velocity, *values of the parameters in their order), compiled by `laws.law`.
    parameters: with ranges in which a search begins; without sizes, the law must give 0.
  """
  operator: type[ForceLaw] = type(f"Force_{name}", (ForceLaw,), {"__doc__": summary})
  kind = Kind(name, summary, "joint", "force", tuple(parameters), operator, law)
  operator.kind = kind
  return kind
