"""The library: every kind of effect that one joint's logs can show.

Bounds are wide of the kinds' plausible ranges (`suite.effects`), so that a fit that ends on one is
a sign of a wrong kind. Starts are several where the error has several valleys.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np

from nerf2real.suite.effects.registry import KINDS
from nerf2real.sysid.hypotheses import force_law, measured_supply
from nerf2real.sysid.hypotheses.terms import COGGING, Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import JointPlant

_INF = float("inf")

_SEEN = 2.0
"""Waves within the joint's motion that a torque must have to be known to repeat: chosen, the least
number."""

_WIND_UP = 0.004
"""rad, of a slide of half its motion; ours: about what a gear of metal gives way under the torque
that it works at."""

_DELAYS = tuple(0.004 * 1.35**k for k in range(14))
"""s, to 0.2: close enough for one to be in the valley of the least error; ours, each a third later,
where the first are nearest."""

_TEETH = 0.5
"""Share that the stiffness of teeth differs from what is usual; a gap and soft teeth are alike."""

_BENDS = (0.0005, 0.002, 0.006)
"""Of half the motion, where the search for presliding starts; chosen."""
_MOST_BENT = 0.05  # of it, by the dry friction; chosen

SHORTEST = 300.0
"""1/rad (1/m), of waves of torque over position that are looked for; chosen."""

_BOUNCY = 0.15
"""Damping ratio of teeth that meet; ours: they bounce."""


def library(plant: JointPlant) -> list[Term]:
  """Returns the candidates for a joint."""
  joint = plant.joint
  top = plant.declared[INDEX["highest"]]
  reach = _reach(plant)
  torque = typical_torque(plant)
  speed = typical_speed(plant)
  most = strongest(plant)
  rubs, drags = 0.1 * torque / speed, 0.1 * torque / speed**2
  terms = [
    _one("command_delay", joint, "delay", 0.0, 0.25, 0.01, _DELAYS),
    _drift(plant),
    _one("coulomb_friction", joint, "torque", 0.0, most, 0.1 * torque, (0.05 * torque,)),
    _one("viscous_friction", joint, "coefficient", 0.0, 2 * torque / speed, rubs, (rubs,)),
    Term(
      "stribeck_friction",
      joint,
      ("breakaway", "velocity"),
      (0.0, 0.002 * speed),
      (most, 0.5 * speed),  # a larger one would hold the joint throughout
      (0.05 * torque, 0.03 * speed),
      ((0.05 * torque, 0.02 * speed), (0.05 * torque, 0.15 * speed)),
    ),
    *(
      dataclasses.replace(
        _one("load_friction", joint, "coefficient", 0.0, 0.8, 0.1, (0.1, 0.3)),
        fixed=(("carried", float(kind)),),
      )
      for kind in (0, 1, 2)  # the actuator's torque, less its damping, what the link takes
    ),
    Term(
      "asymmetric_friction",
      joint,
      ("positive", "negative"),
      (0.0, 0.0),
      (most, most),
      (0.1 * torque, 0.1 * torque),
      ((0.06 * torque, 0.01 * torque), (0.01 * torque, 0.06 * torque)),
    ),
    _one("quadratic_drag", joint, "coefficient", 0.0, 2 * torque / speed**2, drags, (drags,)),
    _play(plant, encoder_on_motor=False),
    _one("motor_gain", joint, "gain", 0.05, 3.0, 0.1, (0.4, 0.75, 1.25)),
    Term(
      "supply_sag",
      None,
      ("droop", "fade"),
      (0.0, 0.0),
      (0.5 / torque, 0.04),
      (0.03 / torque, 0.003),
      ((0.05 / torque, 0.001), (0.01 / torque, 0.01)),
    ),
    Term(
      "thermal_derating",
      joint,
      ("heating", "time_constant"),
      (0.0, 3.0),
      (60.0 / torque**2, 1000.0),
      (1.0 / torque**2, 30.0),
      ((1.0 / torque**2, 60.0), (5.0 / torque**2, 10.0)),
      fixed=(("derating", 0.004),),
    ),
    Term(
      "spring",
      joint,
      ("stiffness", "reference"),
      (0.0, -2.0 * reach),
      (3 * torque / reach, 2.0 * reach),
      (0.1 * torque / reach, 0.1 * reach),
      tuple((0.1 * torque / reach, at * reach) for at in (0.0, 0.7, -0.7)),
    ),
  ]
  weaker = {"motor_gain", "supply_sag", "thermal_derating"}
  terms = [v for t in terms for v in (_weakenings(plant, t) if t.kind in weaker else [t])]
  told = measured_supply.told(plant, [t for t in terms if t.kind == "supply_sag"])
  terms = [t for t in terms if t.kind != "supply_sag"] + told
  if plant.holds:
    terms.append(_one("measurement_delay", joint, "delay", 0.0, 0.15, 0.01, _DELAYS[:-1]))
    terms.append(_play(plant, encoder_on_motor=True))
  if plant.holds or plant.hinge:  # a slide without a servo has no place that its zero could show
    terms.append(_one("encoder_offset", joint, "offset", -0.4, 0.4, 0.03, (0.03, -0.03)))
  terms.append(_payload(plant))
  terms.append(
    Term(
      "gravity_tilt",
      None,
      ("x", "y"),
      (-0.5, -0.5),
      (0.5, 0.5),
      (0.03, 0.03),
      ((0.03, 0.03), (-0.03, -0.03)),
      (0.3, 0.3),
    )
  )
  limit = most if not np.isfinite(top) else min(top, most)
  terms.append(
    Term(
      "torque_limit",
      joint,
      ("limit",),
      (0.05 * limit,),
      (limit,),
      (0.05 * limit,),
      ((0.9 * limit,), (0.7 * limit,), (0.45 * limit,)),
    )
  )
  return terms + [force_law.term_of(plant, kind) for kind in KINDS.values() if kind.law is not None]


def _drift(plant: JointPlant) -> Term:
  """Returns a clock's drift; by the end of the longest log it is as late as late commands begin."""
  longest = max(float(log.time[-1] - log.time[0]) for log in plant.logs)
  rates = tuple(sign * late / longest for late in _DELAYS for sign in (1.0, -1.0))
  return _one("clock_drift", None, "rate", -0.05, 0.05, 0.003, rates)


def _weakenings(plant: JointPlant, term: Term) -> list[Term]:
  """Returns a weakened actuator in its forms: whether its limit falls too, whether efforts tell."""
  limited = np.isfinite(plant.declared[INDEX["highest"]])
  told = all(log.effort is not None for log in plant.logs) and not plant.logs_duty
  told = told and term.kind != "motor_gain"
  forms = [
    dataclasses.replace(
      term, fixed=(*term.fixed, ("scales_limit", float(scales)), ("effort_tells", float(tells)))
    )
    for scales in ((0, 1) if limited else (0,))
    for tells in ((1, 0) if told else (1,))
  ]
  damped = plant.declared[INDEX["damping"]] > 0
  if damped and (term.kind == "thermal_derating" or (limited and term.kind == "supply_sag")):
    # What heats a motor and what its bridge draws is current, of which back-EMF takes.
    draws = ((), (("pulsed", 1.0),)) if term.kind == "supply_sag" else ((),)
    of_current = [
      _of_current(plant, dataclasses.replace(form, fixed=(*form.fixed, *draw)))
      for form in forms
      if dict(form.fixed)["scales_limit"] == limited
      for draw in draws
    ]
    forms = [dataclasses.replace(f, fixed=(*f.fixed, ("back_emf", 0.0))) for f in forms]
    forms += of_current
  if limited and damped and term.kind == "motor_gain":
    # A weak motor: its back-EMF, part of the joint's damping, falls with its torque.
    forms.append(dataclasses.replace(term, fixed=(*forms[-1].fixed, ("scales_damping", 1.0))))
  if term.kind == "motor_gain" and plant.declared[INDEX["velocity"]] != 0:
    forms.append(dataclasses.replace(term, fixed=(*term.fixed, ("position_alone", 1.0))))
  return forms


def _of_current(plant: JointPlant, term: Term) -> Term:
  """Returns a form of heat or supply by current that begins where as much is lost as by torque."""
  torque, current = plant.declared_torque(), plant.declared_torque(of_current=True)
  if dict(term.fixed).get("pulsed"):
    more = torque.mean() / max(np.mean(current), 1e-12)
  elif term.kind == "supply_sag":  # duty times current, as torque
    more = plant.declared[INDEX["highest"]] * torque.mean() / max(np.mean(torque * current), 1e-12)
  else:
    more = np.mean(torque**2) / max(np.mean(current**2), 1e-12)
  return dataclasses.replace(
    term,
    high=(more * term.high[0], *term.high[1:]),
    scale=(more * term.scale[0], *term.scale[1:]),
    starts=tuple((more * size, *rest) for size, *rest in term.starts),
    fixed=(*term.fixed, ("back_emf", 1.0)),
  )


def cogging(plant: JointPlant, waves: list[tuple[float, float, float]]) -> Term:
  """Returns the candidate of a torque that repeats with position, from (amplitude, periods, phase).

  Its error has a valley every fraction of a wave: the starts come from the residual torque's
  spectrum over position (`signatures.waves`). Waves that the motion does not show twice are not
  known to repeat: with a spring they imitate any smooth force. Waves whose number over the range
  of the motion differs by one are different effects, of which the spectrum has chosen.
  """
  torque = typical_torque(plant)
  longest = min(np.pi * _SEEN / _reach(plant), SHORTEST - 1.0)
  return Term(
    COGGING,
    plant.joint,
    ("amplitude", "periods", "phase"),
    (0.0, longest, -10.0),
    (strongest(plant), SHORTEST, 10.0),
    (0.03 * torque, 0.05, 0.3),
    tuple(waves),
    choices=max((SHORTEST - longest) * _reach(plant) / np.pi, 1.0),
  )


def presliding(plant: JointPlant) -> Term | None:
  """Returns contacts that bend before they slide: machines have such, and models leave them out.
  None where a joint is declared without dry friction."""
  if plant.declared[INDEX["friction"]] <= 0.0:
    return None
  reach = _reach(plant)
  starts = tuple(share * reach for share in _BENDS)
  most, scale = _MOST_BENT * reach, starts[0]
  term = _one("presliding", plant.joint, "reach", 0.0, most, scale, starts)
  return dataclasses.replace(term, prior=(_INF,), centre=(0.0,))


def _play(plant: JointPlant, *, encoder_on_motor: bool) -> Term:
  """Returns play in the gear, with how stiff its teeth are and how far they bounce.

  They are fitted beside the gap, which a soft gear widens.
  """
  reach = _reach(plant)
  stiffness = typical_torque(plant) / (_WIND_UP * (1.0 if plant.hinge else reach))
  inertia = float(np.mean([s.inertia.mean() for s in plant.surroundings]))
  armature = plant.declared[INDEX["armature"]]
  smaller = 1.0 / (1.0 / armature + 1.0 / inertia) if armature > 0 else 0.05 * inertia
  damping = 2.0 * _BOUNCY * float(np.sqrt(stiffness * smaller))
  return Term(
    "backlash",
    plant.joint,
    ("gap", "stiffness", "damping"),
    (0.0, 0.1 * stiffness, 0.02 * damping),
    (0.3 * reach, 10 * stiffness, 20 * damping),
    (0.03 * reach, 0.3 * stiffness, 0.3 * damping),
    tuple(
      (gap * reach, stiffness, times * damping)
      for gap, times in ((0.01, 1.0), (0.01, 3.0), (0.04, 1.0), (0.04, 3.0))
    ),
    (_INF, _TEETH * stiffness, 2.0 * _TEETH * damping),
    (0.0, stiffness, damping),
    fixed=(("encoder_on_motor", float(encoder_on_motor)),),
  )


def _payload(plant: JointPlant) -> Term:
  body = plant.model.jnt_bodyid[plant.model.joint(plant.joint).id]
  name = plant.model.body(int(body)).name or plant.joint
  mass = max(float(plant.model.body_mass[body]), 0.05)
  place = np.array(plant.model.body_ipos[body])
  held = _held(plant, int(body))
  size = max(float(np.linalg.norm(place)), 0.05, held.size)
  if not plant.hinge:
    return Term(
      "payload",
      name,
      ("mass", "x", "y", "z"),
      (0.0, 0, 0, 0),
      (3 * mass, 1e-9, 1e-9, 1e-9),
      (0.1 * mass, 1.0, 1.0, 1.0),
      ((0.1 * mass, 0.0, 0.0, 0.0),),
    )
  reach = max(2.5 * size, 1.5 * held.extent)
  return Term(
    "payload",
    name,
    ("mass", "x", "y", "z"),
    (0.0, -reach, -reach, -reach),
    (8 * mass, reach, reach, reach),
    (0.2 * mass, 0.3 * size, 0.3 * size, 0.3 * size),
    tuple((m * mass, *(at * place)) for m in (0.3, 1.0, 3.0) for at in (1.0, 1.7, -0.5)),
    (_INF, size, size, size),
  )


class _Held(NamedTuple):
  """What a body has in its hand: itself and all that no other commanded joint moves against it."""

  size: float
  """m from its origin to the farthest centre of mass of what it holds; 0 where it holds nothing."""
  extent: float
  """m from its origin to where geoms reach; 0 without any."""


def _held(plant: JointPlant, body: int) -> _Held:
  """Returns what a body holds, at the model's reference pose."""
  model, data = plant.model, mujoco.MjData(plant.model)
  mujoco.mj_kinematics(model, data)
  commanded = {model.joint(name).bodyid[0] for name in plant.reductions[0].log.commands.joints}
  held = [body]
  for other in range(body + 1, model.nbody):
    if model.body_parentid[other] in held and other not in commanded:
      held.append(other)
  origin, geoms = data.xpos[body], np.flatnonzero(np.isin(model.geom_bodyid, held))
  away = np.linalg.norm(data.geom_xpos[geoms] - origin, axis=1) + model.geom_rbound[geoms]
  apart = np.linalg.norm(data.xipos[held[1:]] - origin, axis=1)
  return _Held(float(apart.max(initial=0.0)), float(away.max(initial=0.0)))


def _one(
  kind: str,
  target: str | None,
  name: str,
  low: float,
  high: float,
  scale: float,
  starts: tuple[float, ...],
) -> Term:
  return Term(kind, target, (name,), (low,), (high,), (scale,), tuple((s,) for s in starts))


def _reach(plant: JointPlant) -> float:
  return max(float(np.ptp(np.concatenate([log.position for log in plant.logs]))) / 2, 1e-6)


def typical_speed(plant: JointPlant) -> float:
  speeds = np.concatenate([np.abs(log.velocity) for log in plant.logs])
  return max(float(np.quantile(speeds, 0.98)), 1e-6)


def typical_torque(plant: JointPlant) -> float:
  return max(float(np.quantile(plant.declared_torque(), 0.95)), 1e-6)


def strongest(plant: JointPlant) -> float:
  """Returns the largest torque that the declared model needs in the logs [N m, or N of a slide]."""
  return max(float(plant.declared_torque().max()), 1e-6)
