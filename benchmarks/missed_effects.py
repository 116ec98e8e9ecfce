"""Whether effects that the analyser missed on blind sets were lost by its search or by evidence.

  python benchmarks/missed_effects.py --sets out/blind --only 9021_013 9021_053

Of sets of the first generator whose effects are all at one joint, without references: a joint's
hypotheses are grown as the analyser grows them; then the hidden effects themselves are fitted,
begun at their hidden values, in every form that they have. Where that is clearly better than what
was grown the search had failed; where what was grown lacks an effect and is not clearly worse, the
logs do not tell. Both are of whole courses: what is judged from reading to reading, beside play, is
not looked at, nor what a name must stand besides.
"""

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness
from nerf2real.core import markdown
from nerf2real.sysid.data.opening import load_model, read_logs
from nerf2real.sysid.fit import resolution
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.model.limits.supported import on_a_stand
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.selection.joints.leaving import leaves
from nerf2real.sysid.selection.joints.subject import Subject, prepare
from nerf2real.sysid.selection.search.evidence import Scored, clear
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.selection.search.growth import grow
from nerf2real.sysid.settings import SETTINGS

_ITERATIONS = 8  # of a fit from the hidden values


@dataclasses.dataclass(frozen=True)
class Settings:
  """Which sets to look at."""

  sets: Path = Path("out/blind")
  """Folder of sets with answers.json."""
  only: tuple[str, ...] = ()
  """Names of sets; empty: all that have effects at one joint."""


def main(settings: Settings) -> None:
  """Prints a row for every set."""
  path = settings.sets / "answers.json"
  if not path.is_file():
    raise ValueError(f"Found no {path}, expected sets that benchmarks/make_blind_sets.py drew.")
  answers = json.loads(path.read_text())
  unknown = [name for name in settings.only if name not in answers]
  if unknown:
    raise ValueError(f"Found no sets {unknown} in {settings.sets}, expected some of its answers.")
  rows = []
  for name, answer in answers.items():
    joint = one_joint(answer)
    if joint is None or (settings.only and name not in settings.only):
      continue
    subject = _prepared(settings.sets / name, joint)
    rows.append([name, *row(subject, answer["effects"])])
    print(*rows[-1], flush=True)
  head = ["set", "hidden", "grown", "hidden clear of grown [standard errors]", "lost by"]
  print(markdown.table(head, rows))


def one_joint(answer: Mapping[str, Any]) -> str | None:
  """Returns the joint that all effects of a set are at; None where there is none, or several."""
  effects = answer["effects"]
  joints = {effect.get("joint") for effect in effects}
  known = all(effect.get("in_library", True) for effect in effects)
  return joints.pop() if len(joints) == 1 and known else None


def _prepared(folder: Path, joint: str) -> Subject:
  path = folder / "model.xml"
  compiled = load_model(path)
  logs = read_logs(sorted(folder.glob("train_*.mcap")), compiled)
  model = on_a_stand(path, compiled)
  machine = Machine(model, logs)
  numerics = resolution.numerics(machine)
  if numerics != Numerics(machine.reductions[0].step):
    numerics.apply(model)
    machine = Machine(model, logs)
  tried = len(logs[0].commands.joints)
  return prepare(joint, machine, None, tried=tried, settings=SETTINGS)


def row(subject: Subject, effects: Sequence[Mapping[str, Any]]) -> list[str]:
  """Returns the hidden effects, what was grown, how clear the first is of it, and what lost them.

  Args:
    subject: the joint, nothing of it explained yet.
    effects: hidden there.
  """
  explainer = subject.explainer
  grown = grow(explainer, leaves=lambda item: leaves(subject, item, SETTINGS))
  found = next(item for item in grown if not (item.neutral or item.beside_force))
  hidden = from_values(explainer, effects)
  names = frozenset(str(effect["kind"]) for effect in effects)
  if hidden is None:
    return [_words(names), _words(found.names), "-", "the library"]
  best = explainer.adopt(hidden) if hidden.evidence > found.evidence else hidden
  by = clear(best, explainer.scored[found.terms])
  lacking = names - found.names
  lost = "the search" if by > subject.beyond else "the evidence" if lacking else "nothing"
  return [_words(names), _words(found.names), f"{by:.1f}", lost]


def from_values(explainer: Explainer, effects: Sequence[Mapping[str, Any]]) -> Scored | None:
  """Returns the likeliest hypothesis of effects in any of their forms, begun at their values; None
  where the library lacks a kind.

  Args:
    explainer: of the joint.
    effects: kinds and parameters by name; a parameter that is not given begins where searches do.
  """
  forms = [[t for t in explainer.library if t.kind == effect["kind"]] for effect in effects]
  found = []
  for chosen in itertools.product(*forms):
    terms = (*explainer.base, *chosen)
    x = list(explainer.null.fit.x)
    for term, effect in zip(chosen, effects, strict=True):
      start = zip(term.names, term.starts[0], strict=True)
      x += [float(effect.get(name, value)) for name, value in start]
    low, high = (np.concatenate([getattr(t, end) for t in terms]) for end in ("low", "high"))
    fitter = Fitter([explainer.joint], Layout([terms]))
    fit = fitter.fit(np.clip(x, low, high), iterations=_ITERATIONS)
    found.append(explainer.score(terms, fit))
  return max(found, key=lambda item: item.evidence, default=None)


def _words(names: frozenset[str]) -> str:
  return " + ".join(sorted(names)) or "nothing"


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
