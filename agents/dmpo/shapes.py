"""Checks of array ranks at a function's entry."""

from typing import Any


def check_shapes(**arrays: tuple[Any, int]) -> None:
  """Raises ValueError unless every array has its rank: check_shapes(values=(values, 2))."""
  for name, (array, rank) in arrays.items():
    if array.ndim != rank:
      raise ValueError(
        f"{name} has shape {tuple(array.shape)}: expected {rank} axes, found {array.ndim}."
      )
