"""The compiled joint against MuJoCo with `suite.effects`, kind by kind."""

import dataclasses
import itertools

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.free_force import effect, free_force
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.reduction import Reduction
from tests.sysid.synthetic import ARM, PENDULUM, log_of

# kind, values by name, how far [rad rms] the two may differ: rounding where the arithmetic is the
# same, more where a force enters a step earlier or later.
CASES = [
  # Within a step in which a command arrives, the kernel mixes torques, MuJoCo's side commands.
  ("command_delay", {"delay": 0.0237}, 5e-4),
  ("coulomb_friction", {"torque": 0.2}, 1e-6),
  ("viscous_friction", {"coefficient": 0.4}, 1e-6),
  ("stribeck_friction", {"breakaway": 0.2, "velocity": 0.1}, 1e-5),
  ("load_friction", {"coefficient": 0.15, "carried": 0.0}, 3e-4),
  ("load_friction", {"coefficient": 0.4, "carried": 1.0}, 3e-4),
  ("load_friction", {"coefficient": 0.4, "carried": 2.0}, 3e-4),
  ("load_friction", {"coefficient": 0.3, "carried": 3.0}, 3e-4),
  ("load_friction", {"coefficient": 0.3, "carried": 4.0}, 3e-4),
  (
    "load_friction",
    {"coefficient": 0.05, "quadratic": 0.1, "rest": 0.5, "velocity": 0.4, "carried": 2.0},
    3e-4,
  ),
  ("asymmetric_friction", {"positive": 0.2, "negative": 0.05}, 1e-6),
  ("quadratic_drag", {"coefficient": 0.1}, 1e-6),
  ("presliding", {"reach": 0.03}, 1e-5),
  ("encoder_offset", {"offset": 0.05}, 1e-6),
  ("motor_gain", {"gain": 0.7}, 1e-6),
  ("motor_gain", {"gain": 0.7, "scales_limit": 1.0}, 1e-6),
  ("motor_gain", {"gain": 0.3, "scales_limit": 1.0, "scales_damping": 1.0}, 1e-6),
  ("supply_sag", {"droop": 0.05, "fade": 0.01, "scales_limit": 1.0}, 3e-4),
  (
    "thermal_derating",
    {"heating": 2.0, "time_constant": 20.0, "derating": 0.004, "scales_limit": 1.0},
    3e-4,
  ),
  (
    "thermal_derating",
    {"heating": 2.0, "time_constant": 20.0, "derating": 0.02, "scales_limit": 1, "back_emf": 1},
    3e-4,
  ),
  ("supply_sag", {"droop": 0.4, "fade": 0.01, "scales_limit": 1, "back_emf": 1}, 3e-4),
  (
    "supply_sag",
    {"droop": 0.1, "fade": 0.01, "scales_limit": 1, "back_emf": 1, "pulsed": 1},
    3e-4,
  ),
  ("torque_limit", {"limit": 1.2}, 1e-6),
  ("supply_sag", {"droop": 0.05, "fade": 0.01}, 3e-4),
  ("thermal_derating", {"heating": 2.0, "time_constant": 20.0, "derating": 0.004}, 3e-4),
  ("spring", {"stiffness": 1.0, "reference": 0.3}, 1e-6),
  ("cogging", {"amplitude": 0.2, "periods": 12.0, "phase": 0.4}, 1e-6),
  ("backlash", {"gap": 0.03, "encoder_on_motor": 0.0}, 1e-6),
  ("backlash", {"gap": 0.03, "encoder_on_motor": 0.0, "friction_on_link": 0.4}, 1e-6),
  ("backlash", {"gap": 0.02, "encoder_on_motor": 0.0, "stiffness": 400.0, "damping": 1.5}, 1e-6),
  ("payload", {"mass": 0.2, "x": 0.02, "y": 0.0, "z": -0.1}, 1e-6),
  ("gravity_tilt", {"x": 0.05, "y": 0.1}, 1e-6),
  ("measurement_delay", {"delay": 0.0123}, 1e-6),
]


def _position(plant: JointModel, terms=(), values=()) -> np.ndarray:
  """Returns the simulated positions of the first log."""
  c = compose(plant, terms, np.array(values, float))
  return plant.run(c.p, c.loads, 0, table=c.table).position


@pytest.mark.parametrize(("kind", "values", "tolerance"), CASES, ids=[c[0] for c in CASES])
def test_kind_moves_the_joint_as_mujoco_does(kind: str, values: dict, tolerance: float) -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  target = "arm" if kind == "payload" else ("joint" if kind not in _COMMON else None)
  names = tuple(values)
  zeros = (0.0,) * len(names)
  term = Term(kind, target, names, zeros, zeros, zeros, (zeros,))
  got = _position(plant, [term], [values[n] for n in names])
  want = evaluation.simulate(model, log, [Effect(kind, target, values)])[:, 0]
  bare = _position(plant)
  difference = float(np.sqrt(np.mean((got - want) ** 2)))
  effect = float(np.sqrt(np.mean((bare - want) ** 2)))
  assert effect > 5 * tolerance, "the case must move the joint"
  assert difference < tolerance


@pytest.mark.parametrize(
  "effect",
  [
    Effect("stribeck_friction", "joint", {"breakaway": 0.2, "velocity": 0.3}),
    Effect("backlash", "joint", {"gap": 0.03, "encoder_on_motor": 0.0}),
  ],
  ids=lambda effect: effect.kind,
)
def test_contacts_bend_beside_other_effects_as_in_mujoco(effect: Effect) -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "steps", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  bends = Effect("presliding", "joint", {"reach": 0.01})
  terms = [
    Term(e.kind, e.target, (), (), (), (), ((),), fixed=tuple(e.parameters.items()))
    for e in (effect, bends)
  ]
  want = evaluation.simulate(model, log, [effect, bends])[:, 0]
  rigid = evaluation.simulate(model, log, [effect])[:, 0]
  assert np.sqrt(np.mean((want - rigid) ** 2)) > 1e-3
  assert np.sqrt(np.mean((_position(plant, terms) - want) ** 2)) < 1e-5


_COMMON = ("supply_sag", "gravity_tilt", "clock_drift")


def test_a_gain_of_position_alone_keeps_the_servos_own_damping() -> None:
  damped = PENDULUM.replace('kp="21"', 'kp="21" kv="0.8"')
  model = mujoco.MjModel.from_xml_string(damped)
  log = log_of(damped, "steps", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  forms = [t for t in candidates.library(plant) if t.kind == "motor_gain"]
  alone = next(t for t in forms if dict(t.fixed).get("position_alone"))
  gain = Effect("motor_gain", "joint", {"gain": 0.6, "position_alone": 1.0})
  want = evaluation.simulate(model, log, [gain])[:, 0]
  assert np.sqrt(np.mean((_position(plant, [alone], [0.6]) - want) ** 2)) < 1e-4
  assert np.sqrt(np.mean((_position(plant, [forms[0]], [0.6]) - want) ** 2)) > 1e-3


def test_a_servos_damping_acts_as_eulers_scheme_has_it() -> None:
  damped = PENDULUM.replace('kp="21"', 'kp="21" kv="2"').replace("implicitfast", "Euler")
  model = mujoco.MjModel.from_xml_string(damped)
  log = log_of(damped, "steps", rounding=0.0, duration=4.0)
  course = _position(JointModel(model, "joint", [log]))
  assert np.sqrt(np.mean((course - log.states.position[:, 0]) ** 2)) < 1e-6
  model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  other = _position(JointModel(model, "joint", [log]))
  assert np.sqrt(np.mean((course - other) ** 2)) > 1e-4


def test_a_gear_is_loaded_by_what_a_scaled_back_emf_leaves() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  gain = Effect("motor_gain", "joint", {"gain": 1.47, "scales_limit": 1.0, "scales_damping": 1.0})
  effects = [Effect("load_friction", "joint", {"coefficient": 0.35, "carried": 1.0}), gain]
  terms = [
    Term(e.kind, e.target, (), (), (), (), ((),), fixed=tuple(e.parameters.items()))
    for e in effects
  ]
  want = evaluation.simulate(model, log, effects)[:, 0]
  assert np.sqrt(np.mean((_position(plant, terms) - want) ** 2)) < 3e-4


def test_every_weakening_keeps_its_own_choice_of_limits() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "steps", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  effects = [
    Effect("motor_gain", "joint", {"gain": 0.6, "scales_limit": 1.0}),
    Effect("supply_sag", None, {"droop": 0.04, "fade": 0.0, "scales_limit": 0.0}),
  ]
  terms = [
    Term(e.kind, e.target, (), (), (), (), ((),), fixed=tuple(e.parameters.items()))
    for e in effects
  ]
  got = _position(plant, terms)
  want = evaluation.simulate(model, log, effects)[:, 0]
  assert np.sqrt(np.mean((got - want) ** 2)) < 3e-4
  other = dataclasses.replace(terms[0], fixed=(("gain", 0.6), ("scales_limit", 0.0)))
  unlike = _position(plant, [other, terms[1]])
  assert np.sqrt(np.mean((unlike - want) ** 2)) > 3e-3


def test_every_candidate_is_checked() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  plant = JointModel(model, "joint", [log_of(PENDULUM, "sweep", duration=2.0)])
  kinds = {t.kind for t in candidates.library(plant)}
  assert kinds - {case[0] for case in CASES} == {"clock_drift"}  # checked below


_CARRIAGE = """
<mujoco><option timestep="0.001" integrator="implicitfast"/>
  <worldbody><body name="carriage">
    <joint name="joint" type="slide" axis="1 0 0" damping="3"/>
    <inertial pos="0 0 0" mass="2" diaginertia="1e-3 1e-3 1e-3"/>
  </body></worldbody>
  <actuator><position name="joint" joint="joint" kp="300" kv="20"/></actuator>
</mujoco>"""


def test_a_slide_leans_as_mujoco_has_it() -> None:
  model = mujoco.MjModel.from_xml_string(_CARRIAGE)
  log = log_of(_CARRIAGE, "sweep", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  lean = next(t for t in candidates.library(plant) if t.kind == "gravity_tilt")
  effect = Effect("gravity_tilt", None, {"x": 0.05, "y": 0.1})
  want = evaluation.simulate(model, log, [effect])[:, 0]
  assert np.abs(_position(plant) - want).max() > 5e-3
  np.testing.assert_allclose(_position(plant, [lean], [0.05, 0.1]), want, atol=1e-6)


def test_every_candidate_at_rest_leaves_the_motion_as_it_was() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  plant = JointModel(model, "joint", [log_of(PENDULUM, "steps", duration=2.0)])
  weaker = Term(
    "motor_gain", "joint", (), (), (), (), ((),), fixed=(("gain", 0.6), ("scales_limit", 1.0))
  )
  rough = Term("coulomb_friction", "joint", (), (), (), (), ((),), fixed=(("torque", 0.1),))
  others = [weaker, rough]  # a choice between models, and a friction constraint without creep
  want = _position(plant, others)
  for term in candidates.library(plant):
    idle = term.at_rest(dict(zip(term.names, term.starts[0], strict=True)))
    got = _position(plant, [*others, idle])
    assert idle.name is None
    np.testing.assert_allclose(got, want, atol=1e-9, err_msg=f"{term.kind} {term.fixed}")


def test_a_force_of_any_form_is_that_of_the_suite() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  term = free_force(plant)
  values = np.random.default_rng(0).normal(0.0, 0.3, len(term.names)) * np.array(term.prior)
  want = evaluation.simulate(model, log, [effect(term, values)])[:, 0]
  assert np.sqrt(np.mean((_position(plant) - want) ** 2)) > 3e-3
  assert np.sqrt(np.mean((_position(plant, [term], values) - want) ** 2)) < 1e-6


def test_clock_drift_stretches_time() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "slow", rounding=0.0, duration=4.0)
  plant = JointModel(model, "joint", [log])
  term = Term("clock_drift", None, ("rate",), (0.0,), (0.1,), (0.01,), ((0.0,),))
  got = _position(plant, [term], [0.02])
  declared = _position(plant)
  want = np.interp(log.states.stamp / 1.02, log.states.stamp, declared)
  inner = slice(20, -20)
  assert np.abs(got - want)[inner].max() < 3e-4


@pytest.mark.parametrize("motion", ["sweep", "steps"])
def test_joint_among_moving_others_follows_the_whole_model(motion: str) -> None:
  model = mujoco.MjModel.from_xml_string(ARM)
  log = log_of(ARM, motion, rounding=0.0, duration=6.0)
  for joint in ("shoulder", "elbow"):
    plant = JointModel(model, joint, [log])
    got = _position(plant)
    want = log.states.position[:, log.states.column(joint)]
    assert np.sqrt(np.mean((got - want) ** 2)) < 3e-4


def test_where_all_readings_are_late_the_others_motion_is_prescribed_late_too() -> None:
  model = mujoco.MjModel.from_xml_string(ARM)
  late = Effect("measurement_delay", None, {"delay": 0.03})
  log = log_of(ARM, "sweep", [late], rounding=0.0, duration=5.0)
  left = []
  for of_all in (0.0, 1.0):
    term = Term(
      "measurement_delay", None, (), (), (), (), ((),), fixed=(("delay", 0.03), ("of_all", of_all))
    )
    course = _position(JointModel(model, "shoulder", [log]), [term])
    left.append(np.sqrt(np.mean((log.states.position[:, 0] - course) ** 2)))
  assert left[1] < 0.2 * left[0]


def test_what_prescribing_the_others_misses_is_known_from_the_declared_machine() -> None:
  model = mujoco.MjModel.from_xml_string(ARM)
  # an elbow as heavy as the upper arm, without a rotor's inertia that would hide the others
  model.dof_armature[:] = 0.0
  model.body_mass[2], model.body_inertia[2] = 1.0, 5e-3
  declared = log_of(ARM, "steps", rounding=0.0, duration=6.0)
  course = evaluation.simulate(model, declared)
  noise = 3e-4 * np.random.default_rng(1).standard_normal(course.shape)
  states = dataclasses.replace(declared.states, position=course + noise)
  log = dataclasses.replace(declared, states=states)
  for column, joint in enumerate(log.joints):
    plant = JointModel(model, joint, [log])
    missed = plant.run(plant.declared, (), 0).position - course[:, column]
    told = plant.reduction_error(0)
    assert told.shape == missed.shape
    assert np.sqrt(np.mean(told**2)) == pytest.approx(np.sqrt(np.mean(missed**2)), rel=0.5)
    large = np.abs(missed) > 3.0 * np.sqrt(np.mean(missed**2))
    assert np.median(told[large]) > 2.0 * np.median(told)
  alone = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", [log_of(PENDULUM, "sweep")])
  assert np.all(alone.reduction_error(0) == 0.0)


def test_surroundings_of_a_payload_are_those_of_a_heavier_model() -> None:
  heavier = ARM.replace(
    '<inertial pos="0 0.01 -0.08" mass="0.3" diaginertia="8e-4 8e-4 1e-4"/>',
    '<inertial pos="0 0.01 -0.08" mass="0.3" diaginertia="8e-4 8e-4 1e-4"/>'
    '<body pos="0.02 0.1 -0.05"><inertial pos="0 0 0" mass="0.2" diaginertia="1e-9 1e-9 1e-9"/>'
    "</body>",
  )
  log = log_of(ARM, "sweep", rounding=0.0, duration=3.0)
  plain = JointModel(mujoco.MjModel.from_xml_string(ARM), "shoulder", [log])
  model, moved = mujoco.MjModel.from_xml_string(heavier), plain.reductions[0].detailed
  loaded = JointModel(model, "shoulder", [log], reductions=[Reduction(model, log, motion=moved)])
  zeros = (0.0,) * 4
  payload = Term("payload", "lower", ("mass", "x", "y", "z"), zeros, zeros, zeros, (zeros,))
  got = plain.at_samples(compose(plain, [payload], np.array([0.2, 0.02, 0.1, -0.05])).loads, 0)
  np.testing.assert_allclose(got, loaded.at_samples((), 0), atol=2e-7)


def test_pairs_move_the_joint_as_mujoco_does() -> None:
  # A kind may use what another one changes: the torque that acts, the friction, the strength.
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=2.0)
  plant = JointModel(model, "joint", [log])
  cases = [*{case[0]: case for case in reversed(CASES)}.values()]  # the first of a kind
  cases.append(("backlash", {"gap": 0.01, "encoder_on_motor": 1.0}, 2e-3))
  wrong = []
  for first, second in itertools.combinations(cases, 2):
    if _share_a_place(first[0], second[0]):
      continue
    values = [*first[1].values(), *second[1].values()]
    terms, effects = zip(*(_case(kind, v) for kind, v, _ in (first, second)), strict=True)
    got = _position(plant, terms, values)
    want = evaluation.simulate(model, log, list(effects))[:, 0]
    if float(np.sqrt(np.mean((got - want) ** 2))) > 4e-3:
      wrong.append((first[0], second[0]))
  assert not wrong


def _share_a_place(first: str, second: str) -> bool:
  """Tells whether the kernel holds one of two kinds at a time, or one flag of both's limits."""
  return first == second or {first, second} <= {"motor_gain", "supply_sag", "thermal_derating"}


def test_terms_are_composed_alike_in_any_order() -> None:
  log = log_of(PENDULUM, "sweep", rounding=0.0, duration=1.0)
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", [log])
  weak = ("motor_gain", {"gain": 0.2, "scales_limit": 1.0, "scales_damping": 1.0}, 0.0)
  rough = ("viscous_friction", {"coefficient": 0.1}, 0.0)
  for first, second in itertools.combinations([weak, rough, *CASES], 2):
    if _share_a_place(first[0], second[0]):
      continue
    pair = [(_case(kind, values)[0], [*values.values()]) for kind, values, _ in (first, second)]
    one, other = (
      compose(plant, [term for term, _ in order], np.concatenate([x for _, x in order])).p
      for order in (pair, pair[::-1])
    )
    np.testing.assert_array_equal(one, other, err_msg=f"{first[0]}, {second[0]}")
  # A weak motor's damping is its own; what rubs besides is not its.
  values = np.array([*weak[1].values(), *rough[1].values()])
  composed = compose(plant, [_case(*case[:2])[0] for case in (weak, rough)], values)
  declared = plant.declared[INDEX["damping"]]
  assert composed.p[INDEX["damping"]] == pytest.approx(0.2 * declared + 0.1)


def _case(kind: str, values: dict) -> tuple[Term, Effect]:
  target = "arm" if kind == "payload" else (None if kind in _COMMON else "joint")
  zeros = (0.0,) * len(values)
  return Term(kind, target, tuple(values), zeros, zeros, zeros, (zeros,)), Effect(
    kind, target, values
  )
