"""The report in four answers: what is missing, how sure that is, what remains, what to record."""

from collections.abc import Sequence
from typing import Any

from nerf2real.core.pages.blocks import Table
from nerf2real.core.pages.page import Section
from nerf2real.suite.effects import kind_of
from nerf2real.sysid.model import simulation

_FEW = 4  # effects that are said with their values; more are counted
_LARGE = {"mrad": "rad", "mm": "m"}
_DIGITS = 4  # of a speed: less is standing
_CLEAR = 99.0  # standard errors, beyond which a number says nothing more


def section(content: dict[str, Any], *, beyond: float, unit: str) -> Section:
  """Returns the first section of the report.

  Args:
    content: what report.json holds.
    beyond: standard errors that count as clear.
    unit: of small positions, mrad or mm.
  """
  rows = [
    ["What does the model lack?", _missing(content)],
    ["How sure is that?", _sure(content, beyond)],
    ["What remains?", _remains(content, unit)],
    ["What to record next?", _next(content["next_excitation"], _LARGE[unit])],
  ]
  return Section("In short", "", [Table(["", ""], rows)])


def _missing(content: dict[str, Any]) -> str:
  effects = content["effects"]
  if effects:
    first = "; ".join(_effect(effect) for effect in effects[:_FEW])
    more = len(effects) - _FEW
    return first + (f"; and {more} more, listed below." if more > 0 else ".")
  if content["verdict"] == "none":
    return "Nothing that these logs show."
  joint = content["residual_at"]["joint"]
  nearest = [a for a in content["alternatives"] if "kinds" not in a and a["parameters"]]
  words = f"Something at {joint} for which no name is clear."
  return words + (f" The nearest: {_effect(nearest[0])}." if nearest else "")


def _effect(effect: dict[str, Any]) -> str:
  """Returns an effect with what it is, its values and intervals in words."""
  places = (effect.get("joint"), *(effect.get(noun) for noun in ("body", "geom", "sensor")))
  where = next((place for place in places if place), "all joints")
  values = []
  for name, value in effect["parameters"].items():
    if isinstance(value["value"], list) or None in (value["value"], value["low"], value["high"]):
      continue
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    low, high = (f"{value[end]:.3g}" for end in ("low", "high"))
    values.append(f"{name} {value['value']:.3g}{unit} ({low} to {high})")
  words = f"{effect['kind']} at {where} ({kind_of(effect['kind']).summary})"
  return words + (f": {', '.join(values)}" if values else "")


def _sure(content: dict[str, Any], beyond: float) -> str:
  alike = [a["kind"] for a in content["alternatives"] if a.get("confounded")]
  effects = content["effects"]
  if not effects and content["verdict"] == "none":
    return "No hypothesis with an effect is clear of the one without."
  if not effects:
    return "Not sure: no name is clear of every other."
  clear = [effect.get("evidence", {}).get("clear_by_standard_errors") for effect in effects]
  least = min((c for c in clear if c is not None), default=None)
  words = ""
  if least is not None:
    size = f"{least:.1f} standard errors or more"
    size = size if least < _CLEAR else f"more than {_CLEAR:.0f} standard errors"
    words = f"Every {'other ' if alike else ''}explanation without it is worse by {size},"
    words += f" where {beyond:.1f} are asked. "
  if alike:
    words += f"These logs do not tell it from {_either(alike)}. "
  return words + "Brackets hold 95 % intervals."


def _either(names: Sequence[str]) -> str:
  return " or ".join(dict.fromkeys(name.replace("+", " with ") for name in names))


def _remains(content: dict[str, Any], unit: str) -> str:
  held = content["error"]["held"]
  error, which = (held, "were not fitted") if held else (content["error"]["train"], "were fitted")
  after, floor = error["after"], content["error"]["floor"]
  words = f"{1e3 * after:.3g} {unit} of {1e3 * error['before']:.3g} on logs that {which},"
  words += f" {after / max(floor, 1e-12):.1f} times the readings' noise."
  if simulation.is_worse(error):
    words += " The extended model is worse than the declared one: do not use it."
  if content["verdict"] in ("partly", "unexplained"):
    at = content["residual_at"]
    low, high = (round(at["velocity"][end], _DIGITS) + 0.0 for end in ("low", "high"))
    words += f" On the fitted logs most is at {at['joint']}, in {at['log']},"
    words += f" at {low:.2g} to {high:.2g} {_LARGE[unit]}/s."
  return words


def _next(proposal: dict[str, Any], unit: str) -> str:
  rivals = _either(["+".join(names) for names in proposal["separates"] if names])
  apart, would = proposal.get("separation_in_noise"), proposal.get("would")
  motion = proposal["design"]
  if "centre_rad" in proposal:
    amplitude, centre = proposal["amplitude_rad"], proposal["centre_rad"]
    motion += f", {amplitude:.2g} {unit} about {centre:.2g} {unit}"
  reasons = [f"it would {would}"] if would else []
  if rivals and apart is None:
    reasons.append(f"it may tell the effect from {rivals}")
  elif rivals and apart is not None and apart >= 1.0:
    reasons.append(f"the nearest rival, of {rivals}, would differ by {apart:.1f} times the noise")
  if reasons:
    return f"{motion}: {'; '.join(reasons)}."
  if rivals:
    return (
      f"No motion that was tried tells the effect from {rivals}: they differ by less than noise."
    )
  return "Nothing in particular."
