"""The report in four answers: what is missing, how sure, what remains, what to record next."""

from collections.abc import Sequence
from typing import Any

from nerf2real.core.pages.blocks import Answer, Answers
from nerf2real.core.pages.page import Section
from nerf2real.suite.effects import kind_of
from nerf2real.sysid.model import simulation
from nerf2real.sysid.report.alike import place

_FEW = 4  # effects that are said with their values; more are counted
_LARGE = {"mrad": "rad", "mm": "m"}
_DIGITS = 4  # of a speed: less is standing
_CLEAR = 99.0  # standard errors, beyond which a number says nothing more
_TIMES = 1000.0  # the noise, beyond which a number says nothing more
_GAIN = 0.01  # nats of parts of the logs that were left out, as reports round them; less is none
_SEEN = 1.0  # noise by which predictions have to differ under a motion that is worth recording
_FAR = 100.0
"""Times the readings' noise from which on a remainder is not one that a healthy machine leaves:
chosen, twice the largest of those that were found to have nothing in the blind sets (0.7 to 50)."""
_CALIBRATED = 1.5  # times by which fitted constants lower the error, from which that is said


def section(
  content: dict[str, Any], *, asked: Sequence[float], unit: str, shown: str, referred: bool
) -> Section:
  """Returns the first section of the report.

  Args:
    content: what report.json holds.
    asked: standard errors that a joint's clearest effect must be clear by, the next, and so on.
    unit: of small positions, mrad or mm.
    shown: what the logs can show, in a sentence.
    referred: whether there were reference logs.
  """
  answers = [
    _missing(content, referred),
    _sure(content, asked, shown),
    _remains(content, unit),
    _next(content, _LARGE[unit]),
  ]
  return Section("In short", "", [Answers(answers)])


def _missing(content: dict[str, Any], referred: bool) -> Answer:
  question = "What does the model lack?"
  effects, own = content["effects"], content["in_reference"]
  known = [f"In the reference, too: {_effect(effect)}." for effect in own[:_FEW]]
  if effects:
    several = len(effects) > 1
    words = [
      _sentence((f"{_name(effect)}: " if several else "") + f"{_meaning(effect)}.")
      for effect in effects[:_FEW]
    ]
    more = len(effects) - _FEW
    title = ", ".join(_name(effect) for effect in effects[:_FEW])
    title += f", and {more} more, listed below" if more > 0 else ""
    partly = content["verdict"] == "partly"
    title += "; and something that has no clear name" if partly else ""
    words.append("In brackets: 95 % intervals.")
    return Answer(question, _sentence(title), [*words, *known], "warn" if partly else "")
  if content["verdict"] == "none":
    if not referred and is_far(content["error"]):
      words = [
        "The model moves otherwise than the machine by far more than the readings' noise, and no"
        " effect that was tried is what does it: see the notes, and what the model leaves out."
      ]
      return Answer(
        question,
        "Nothing that has a name, yet the model does not fit",
        [*words, *known],
        tone="warn",
      )
    title = "has changed since the reference" if referred else "that these logs show"
    return Answer(question, f"Nothing {title}", known, tone="good")
  joint = content["residual_at"]["joint"]
  nearest = [a for a in content["alternatives"] if "kinds" not in a and a["parameters"]]
  better = [a for a in nearest if a["evidence"].get("held_out_gain_nats", _GAIN) >= _GAIN]
  named = [a for a in better if a["kind"] != "parameter_error"] or better
  words = [f"The nearest, which is not claimed: {_effect(named[0])}."] if named else []
  if nearest and not named:
    words = ["No effect that was tried predicts parts of the logs better that were left out."]
  return Answer(question, f"Something at {joint} that has no clear name", [*words, *known], "warn")


def is_far(error: dict[str, Any]) -> bool:
  """Tells whether more remains, of the logs that are judged, than healthy machines leave."""
  return times_of_noise(error) > _FAR


def times_of_noise(error: dict[str, Any]) -> float:
  """Returns what the extended model leaves on the logs that are judged, over the readings' noise.

  Args:
    error: of report.json.
  """
  left = float((error["held"] or error["train"])["after"])
  return left / max(float(error["floor"]), 1e-12)


def _sentence(words: str) -> str:
  return words[:1].upper() + words[1:]


def _name(effect: dict[str, Any]) -> str:
  """Returns an effect's kind and place as words."""
  return f"{effect['kind'].replace('_', ' ')} at {place(effect, 'all joints')}"


def _effect(effect: dict[str, Any]) -> str:
  return f"{_name(effect)}: {_meaning(effect)}"


def _meaning(effect: dict[str, Any]) -> str:
  """Returns what an effect is, its values and intervals in words."""
  values = []
  for name, value in effect["parameters"].items():
    if None in (value["value"], value["low"], value["high"]):
      continue
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    low, high = (f"{value[end]:.3g}" for end in ("low", "high"))
    values.append(f"{name} {value['value']:.3g}{unit} ({low} to {high})")
  words = kind_of(effect["kind"]).summary
  return words + (f"; {', '.join(values)}" if values else "")


def _sure(content: dict[str, Any], asked: Sequence[float], shown: str) -> Answer:
  question = "How sure is that?"
  alike = not_told_apart(content["alternatives"])
  effects = content["effects"]
  if not effects and content["verdict"] == "none":
    return Answer(question, "No effect is clearly better than none", [shown], tone="good")
  if not effects:
    return Answer(question, "Not sure: no name is clear of every other", [], tone="warn")
  words = [alike] if alike else []
  tone = "warn" if alike else "good"
  pairs = _clearness(effects, asked)
  if not pairs:
    return Answer(question, "See the evidence below", words, tone)
  least, needed = min(pairs, key=lambda pair: pair[0] - pair[1])
  size = f"{least:.1f}" if least < _CLEAR else f"More than {_CLEAR:.0f}"
  others = f"By so much every {'other ' if alike else ''}explanation without it is worse"
  which = ", for the least certain" if len(pairs) > 1 else ""
  return Answer(
    question,
    f"{size} standard errors{which}; {needed:.1f} are asked",
    [f"{others}, on parts of the logs that were left out.", *words],
    tone,
  )


def alike_by_place(alternatives: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
  """Returns the kinds that the logs do not tell from what was found, by joint; all where none is
  said."""
  found: dict[str, list[str]] = {}
  for other in alternatives:
    if other.get("confounded"):
      found.setdefault(other.get("joint") or "all joints", []).append(other["kind"])
  return found


def not_told_apart(alternatives: Sequence[dict[str, Any]]) -> str:
  """Returns in a sentence what logs do not tell from what was found, of several joints at which;
  empty where they tell all."""
  kinds = alike_by_place(alternatives)
  if not kinds:
    return ""
  if len(kinds) == 1:
    (own,) = kinds.values()
    return f"These logs do not tell it from {either(own, ())}."
  places = list(kinds)
  more = f" and {len(places) - _FEW} more" if len(places) > _FEW else ""
  return (
    f"At {', '.join(places[:_FEW])}{more} other explanations are as good: they are listed below."
  )


def _clearness(
  effects: Sequence[dict[str, Any]], asked: Sequence[float]
) -> list[tuple[float, float]]:
  """Returns by how many standard errors effects are clear, and what is asked of each: of a joint's
  n-th clearest more than of its clearest. What a servo's law alone shows is one by itself."""
  of_joint: dict[Any, list[float]] = {}
  for number, effect in enumerate(effects):
    evidence = effect.get("evidence", {})
    clear = evidence.get("clear_by_standard_errors")
    if clear is not None:
      key = number if evidence.get("servo_law") else effect["joint"]
      of_joint.setdefault(key, []).append(clear)
  return [
    (clear, asked[min(rank, len(asked) - 1)])
    for found in of_joint.values()
    for rank, clear in enumerate(sorted(found, reverse=True))
  ]


def either(names: Sequence[str], claimed: Sequence[str]) -> str:
  """Returns hypotheses such as "a+b" in words; `claimed` are the kinds that the report names."""
  words = []
  for name in names:
    kinds = name.split("+")
    more = [kind for kind in kinds if kind not in claimed]
    if claimed and more and set(claimed) < set(kinds):
      words.append(" + ".join(("the same", *more)))
    else:
      words.append(" + ".join(kinds))
  return " or ".join(dict.fromkeys(words)).replace("_", " ")


def _remains(content: dict[str, Any], unit: str) -> Answer:
  question = "What remains?"
  held = content["error"]["held"]
  error, which = (held, "were not fitted") if held else (content["error"]["train"], "were fitted")
  before, after, floor = error["before"], error["after"], content["error"]["floor"]
  times = times_of_noise(content["error"])
  often = f"{times:.1f}" if times < _TIMES else f"over {_TIMES:.0f}"
  title = f"{1e3 * after:.3g} {unit}, {often} times the readings' noise"
  words = [f"The declared model leaves {1e3 * before:.3g} {unit} on the same logs, which {which}."]
  tone = ""
  if content["verdict"] == "none" and before > _CALIBRATED * after:
    known = "what the reference shows, too, and " if content["in_reference"] else ""
    words.append(f"What lowers it: {known}its constants, fitted within their tolerances.")
  if simulation.is_worse(error):
    words.append("The extended model is worse than the declared one: do not use it.")
    tone = "warn"
  if content["verdict"] in ("partly", "unexplained"):
    at = content["residual_at"]
    low, high = (round(at["velocity"][end], _DIGITS) + 0.0 for end in ("low", "high"))
    words.append(
      f"On the fitted logs most is at {at['joint']}, in {at['log']},"
      f" at {low:.2g} to {high:.2g} {_LARGE[unit]}/s."
    )
    tone = "warn"
  sizes = {"declared": before, "extended": after, "noise of the readings": floor}
  bars = {f"{name}, {1e3 * size:.3g} {unit}": size for name, size in sizes.items()}
  return Answer(question, title, words, tone or "good", bars)


def _next(content: dict[str, Any], unit: str) -> Answer:
  question = "What to record next?"
  proposal = content["next_excitation"]
  claimed = [e["kind"] for e in content["effects"] if e.get("joint") == proposal.get("joint")]
  sets = ["+".join(names) for names in proposal["separates"] if names]
  rivals = either(sets, claimed)
  apart, would = proposal.get("separation_in_noise"), proposal.get("would")
  motion = _sentence(proposal["design"])
  if "centre_rad" in proposal:
    amplitude, centre = proposal["amplitude_rad"], proposal["centre_rad"]
    motion += f", {amplitude:.2g} {unit} about {centre:.2g} {unit}"
  reasons = [f"It would {would}."] if would else []
  if rivals and apart is None:
    reasons.append(f"It may tell what is found from {rivals}.")
  elif rivals and apart is not None and apart >= _SEEN:
    reasons.append(
      f"What is found and its nearest rival, of {rivals}, would differ by {apart:.1f} times the"
      " noise."
    )
  if reasons:
    return Answer(question, motion, reasons)
  if rivals and content["verdict"] != "none":
    return Answer(
      question,
      "No motion that was tried would tell more",
      [f"{_sentence(rivals)} would differ from what is found by less than the noise."],
    )
  return Answer(question, "Nothing in particular", [], tone="good")
