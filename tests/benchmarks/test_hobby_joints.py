"""The hobby joints' equations against MuJoCo and closed forms; their sets: repeatable, readable."""

import dataclasses

import mujoco
import numpy as np
import pytest

from benchmarks import identify, make_blind_sets
from benchmarks.blind_sets import scoring
from benchmarks.hobby_joints import (
  bodies,
  effects,
  following,
  gears,
  machines,
  recording,
  servos,
  sets,
)
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.effects.registry import KINDS

TICK = 20
PERIOD = TICK * servos.STEP


def frictionless(plant, seed=5):
  """Returns a machine that nothing damps or drives."""
  machine = machines.on_paper(plant, np.random.default_rng(seed))
  zero = np.zeros(len(machine.joints))
  quiet = {"rest": zero, "of_load": zero, "viscous": zero, "damping": zero}
  gear = machine.gear._replace(dry=1e-9 + zero, **quiet)
  drive = machine.drive._replace(most=zero, resistance=1e9 + zero)
  return dataclasses.replace(machine, gear=gear, drive=drive)


def run(machine, goals, lead=0.0):
  """Returns the rows of a run without noise; goals [T, n]."""
  parts = (machine.body, machine.drive, machine.gear, machine.supply)
  return servos.simulate(*parts, goals, np.zeros_like(goals), TICK, lead)


def hold(machine, place, seconds):
  return np.tile(np.asarray(place, float), (round(seconds / PERIOD), 1))


@pytest.mark.parametrize("plant", machines.PLANTS)
def test_accelerations_are_those_of_mujoco(plant):
  random = np.random.default_rng(3)
  machine = machines.on_paper(plant, random)
  n = len(machine.joints)
  rotors = machine.drive._replace(rotor=np.full(n, 1e-12))
  model = mujoco.MjModel.from_xml_string(
    machines.declared(dataclasses.replace(machine, drive=rotors))
  )
  model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
  model.opt.gravity[:] = [0.7, -0.4, -9.6]
  data, out = mujoco.MjData(model), np.zeros(n)
  body = bodies.body_of(plant, machine.links, machine.turn, model.opt.gravity.copy())
  for _ in range(5):
    data.qpos[:], data.qvel[:] = random.uniform(-1.0, 1.0, n), random.uniform(-4.0, 4.0, n)
    data.qfrc_applied[:] = torque = random.uniform(-0.5, 0.5, n)
    mujoco.mj_forward(model, data)
    bodies.accelerate(body, data.qpos.copy(), data.qvel.copy(), torque, out)
    np.testing.assert_allclose(out, data.qacc, rtol=1e-3, atol=1e-3 * np.abs(out).max())


@pytest.mark.parametrize("plant", ["single", "head", "leg"])
def test_a_load_is_a_point_mass_of_mujoco(plant):
  random = np.random.default_rng(4)
  machine = machines.on_paper(plant, random)
  broken, _, change = effects.LIBRARY["payload"].apply(
    machine, recording.draw_host(3, random), len(machine.joints) - 1, 0.8, random.random(4)
  )
  spec = mujoco.MjSpec.from_string(machines.declared(machine))
  body = spec.body(f"{machine.joints[-1]}_link").add_body(pos=[change[axis] for axis in "xyz"])
  body.mass, body.inertia, body.explicitinertial = change["mass"], [1e-12] * 3, True
  body.ipos = [0.0, 0.0, 0.0]
  model = spec.compile()
  data, n = mujoco.MjData(model), len(machine.joints)
  q, v = random.uniform(-1.0, 1.0, (2, n))
  data.qpos[:], data.qvel[:] = q, v
  mujoco.mj_forward(model, data)
  mass = np.zeros((n, n))
  mujoco.mj_fullM(model, data, mass)
  mass -= np.diag(model.dof_armature)
  out = np.zeros(n)
  bodies.accelerate(broken.body, q, v, np.zeros(n), out)
  expected = np.linalg.solve(mass, -data.qfrc_bias)
  np.testing.assert_allclose(out, expected, rtol=2e-3, atol=2e-3 * np.abs(out).max())


def test_an_undriven_leg_keeps_its_energy():
  machine = frictionless("leg")
  # So much play that links move without their rotors.
  machine = dataclasses.replace(machine, gear=machine.gear._replace(gap=np.full(3, 100.0)))
  rows, links = run(machine, hold(machine, [1.0, -0.7, 0.4], 3.0)), machine.links
  q, v = rows[:, :, servos.LINK], rows[:, :, servos.SPEED]
  angle, rate = np.cumsum(q, 1), np.cumsum(v, 1)
  place, speed, fall, energy = 0.0, 0.0, 0.0, 0.0
  for j in range(3):
    along = np.array([-np.sin(angle[:, j]), -np.cos(angle[:, j])])
    turning = rate[:, j] * np.array([-np.cos(angle[:, j]), np.sin(angle[:, j])])
    depth = -links.centre[j, 2]
    energy = energy + 0.5 * links.mass[j] * ((speed + depth * turning) ** 2).sum(0)
    fall = fall + links.mass[j] * bodies.GRAVITY * (place + depth * along)[1]
    energy += 0.5 * links.inertia[j, 1] * rate[:, j] ** 2
    place, speed = place + links.length[j] * along, speed + links.length[j] * turning
  energy += fall
  assert np.ptp(q[:, 0]) > 0.5
  assert np.ptp(energy) < 5e-3 * np.ptp(fall)


def test_a_motor_without_load_turns_as_the_data_sheet_says():
  machine = frictionless("finger")
  paper = machines.on_paper("finger", np.random.default_rng(5))
  machine = dataclasses.replace(machine, drive=paper.drive, turn=np.eye(3))
  goals = hold(machine, [0.0], 1.0)
  goals[1:] = 10.0  # m, out of reach: full duty
  rows = run(machine, goals)
  assert rows[-1, 0, servos.DUTY] == 1.0
  speed = (rows[-1, 0, servos.LINK] - rows[-201, 0, servos.LINK]) / (200 * PERIOD)
  assert speed == pytest.approx(machine.supply.voltage / paper.drive.constant[0], rel=1e-3)


def test_a_weight_bends_a_servo_by_torque_over_stiffness():
  machine = machines.on_paper("single", np.random.default_rng(8))
  gear = machine.gear._replace(dry=np.full(1, 1e-9), rest=np.zeros(1), of_load=np.zeros(1))
  fine = machine.drive._replace(notch=np.full(1, 1e-6))
  supply = machine.supply._replace(resistance=0.0)
  machine = dataclasses.replace(machine, gear=gear, drive=fine, turn=np.eye(3), supply=supply)
  q = run(machine, hold(machine, [0.5], 3.0))[-1, 0, servos.LINK]
  weight = machine.body.moment[0] * bodies.GRAVITY * np.sin(q)
  assert 0.5 - q == pytest.approx(
    weight / (machine.stall * machine.drive.proportional)[0], rel=1e-3
  )


def test_bristles_hold_what_is_less_and_slide_at_the_stribeck_curve():
  gear = gears.healthy(1, dry=np.ones(1), rest=np.full(1, 0.5), rest_speed=np.full(1, 0.1))
  for speed in (1e-6, 0.1, -0.1, 3.0):
    sliding, z = gears.level(gear, 0, 0.0, speed, 0.0, 0.0), 0.0
    assert sliding == pytest.approx(1.0 + 0.5 * np.exp(-((speed / 0.1) ** 2)))
    for _ in range(200):
      z = gears.bend(z, speed, sliding, 1e3, 1e-4 / abs(speed))
    assert 1e3 * z == pytest.approx(np.sign(speed) * sliding, rel=1e-5)
  assert gears.bend(0.0, 1e-4, 1.0, 1e3, 1e-3) == pytest.approx(1e-7, rel=1e-3)  # a spring at first


def test_a_source_sags_by_what_the_bridges_draw():
  machine = machines.on_paper("single", np.random.default_rng(8))
  goals = hold(machine, [0.0], 1.0)
  goals[:, 0] = 0.8 * np.sin(8.0 * PERIOD * np.arange(len(goals)))
  broken, _, change = effects.LIBRARY["supply_sag"].apply(machine, None, 0, 0.5, np.zeros(4))
  rows = run(broken, goals)
  current, duty = rows[:, 0, servos.CURRENT], rows[:, 0, servos.DUTY]
  torque = broken.drive.constant[0] * current
  share = rows[:, 0, servos.VOLTAGE] / broken.supply.voltage
  own = machine.supply.resistance / machine.supply.voltage / broken.drive.constant[0]
  expected = 1.0 - (change["droop"] + own) * np.roll(duty, 1) * torque
  np.testing.assert_allclose(share[2:], expected[2:], atol=5e-3)
  assert share.min() < 0.99


def test_a_profile_keeps_its_speed_and_arrives():
  machine = machines.on_paper("single", np.random.default_rng(1))
  drive = machine.drive._replace(top_speed=np.full(1, 2.0), ramp=np.full(1, 20.0))
  course = servos.profiled(np.array([[0.0]] + [[1.0]] * 2000), drive, 1e-3)[:, 0]
  speed = np.diff(course) / 1e-3
  assert speed.max() == pytest.approx(2.0) and np.abs(np.diff(speed)).max() < 0.0201
  assert np.abs(course[700:] - 1.0).max() < 2e-3


def test_generators_are_listed_everywhere():
  assert "hobby_joints" in make_blind_sets.WITH_REFERENCES
  assert "hobby_joints" in make_blind_sets.WITH_DAYS
  assert set(identify.FOLDERS) == set(make_blind_sets.GENERATORS)


def test_the_kinds_are_the_librarys_and_others():
  assert len(effects.LIBRARY) >= 20 and len(effects.OUTSIDE) >= 6
  assert set(effects.LIBRARY) <= set(KINDS)
  assert not set(effects.OUTSIDE) & set(KINDS)


@pytest.mark.parametrize("name", [*effects.LIBRARY, *effects.OUTSIDE])
def test_every_kind_changes_what_is_read_and_has_the_librarys_parameters(name):
  kind = {**effects.LIBRARY, **effects.OUTSIDE}[name]
  random = np.random.default_rng(12)
  # An arm that hangs, so that its weight does not keep play closed.
  machine = dataclasses.replace(machines.on_paper(kind.plants[0], random), turn=np.eye(3))
  host = recording.draw_host(1, random)
  broken, listener, change = kind.apply(machine, host, 0, 1.0, np.full(4, 0.3))
  times = recording.command_times(host, 6.0)
  where = machine.ranges[0]
  commands = where.centre + where.amplitude * np.sin(3.5 * times)[:, None]
  logs = [
    recording.record(m, h, commands, np.random.default_rng(1))
    for m, h in ((machine, host), (broken, listener))
  ]
  shift = np.interp(logs[0].time, logs[1].stamp, logs[1].position[:, 0]) - logs[0].position[:, 0]
  assert np.sqrt(np.mean(shift**2)) > 1.5e-3
  if name in effects.LIBRARY:
    assert set(change) <= {parameter.name for parameter in KINDS[name].parameters}
    assert set(change) & set(scoring.SIZES[name])


def followed(machine, host, log, effects_of):
  """Returns the RMS error of the library's effects in the model of a healthy machine."""
  model = mujoco.MjModel.from_xml_string(machines.declared(machine))
  data, stack = mujoco.MjData(model), EffectStack(effects_of).bind(model)
  data.qpos[:] = log.commands[0]
  stack.reset()
  grid = np.arange(-following.LEAD, log.time[-1] + 2e-3, model.opt.timestep)
  heard = np.searchsorted(log.sent + recording.lateness(host), grid + 5e-4) - 1
  course = np.empty((grid.size, 1))
  for k, which in enumerate(np.maximum(heard, 0)):
    course[k] = stack.observe("joint_positions", data.qpos.copy(), data.time)
    stack.before_step(data, log.commands[which])
    mujoco.mj_step(model, data)
  return following.error(following.at(log.stamp, grid, course), log.position)


# Play does not repeat, and stamps are no simulation's.
@pytest.mark.parametrize("name", sorted(set(effects.LIBRARY) - {"backlash", "clock_drift"}))
def test_the_librarys_effect_of_the_same_numbers_explains_what_is_read(name):
  random = np.random.default_rng(12)
  machine = machines.on_paper("single", random)
  upright = machine.links._replace(mass=1.5 * machine.links.mass)
  machine = dataclasses.replace(machine, turn=np.eye(3), links=upright)
  host = recording.draw_host(1, random)
  broken, listener, change = effects.LIBRARY[name].apply(machine, host, 0, 0.9, np.full(4, 0.3))
  times = recording.command_times(host, 8.0)
  where = machine.ranges[0]
  course = 0.6 * np.sin(1.1 * times) + 0.4 * np.sin(4.3 * times)
  commands = where.centre + where.amplitude * course[:, None]
  log = recording.record(broken, listener, commands, np.random.default_rng(1))
  target = "joint" if effects.LIBRARY[name].joint else None
  found = Effect(name, target, {key: float(value) for key, value in change.items()})
  without, explained = (followed(machine, host, log, known) for known in ([], [found]))
  assert explained < 0.6 * without


def test_a_healthy_machine_follows_its_model(tmp_path):
  options = {"seed": 498, "index": 0, "mix": "healthy"}
  for plant, bound in (("single", 6e-3), ("finger", 2.5e-4)):
    truth = sets.make_set(tmp_path / plant, plants=[plant], same_day=True, **options).answer
    assert truth["error_ratio"] == 1.0
    assert 1e-5 < truth["healthy_held_error"] < bound


def test_a_set_is_determined_by_its_seed_and_its_logs_open(tmp_path):
  options = {"seed": 499, "index": 1, "mix": "single", "plants": ["head"]}
  options |= {"kinds": ["viscous_friction"]}
  answer = sets.make_set(tmp_path / "a", **options).answer
  assert sets.make_set(tmp_path / "b", **options).answer == answer
  names = ["held_1_wander", "held_2_points"]
  names += [
    f"{of}_{log}" for of in ("train", "reference") for log in ("1_sweep", "2_slow", "3_steps")
  ]
  assert sorted(path.stem for path in (tmp_path / "a").glob("*.mcap")) == sorted(names)
  for name in names:
    path = f"{name}.mcap"
    assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()
    log = read_log(tmp_path / "a" / path)
    assert log.joints == ("pan", "tilt")
    assert 8.0 < log.duration < 14.0
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "a" / "model.xml"))
  assert model.njnt == model.nu == 2
  assert not answer["below_floor"] and answer["error_ratio"] >= sets.LEAST_RATIO - 0.01
  assert answer["effects"][0]["joint"] in ("pan", "tilt")


def test_choices_that_are_not_there_are_refused(tmp_path):
  with pytest.raises(ValueError, match="trampoline"):
    sets.make_set(tmp_path, seed=0, index=0, plants=["trampoline"])
  with pytest.raises(ValueError, match="payload"):
    sets.make_set(tmp_path, seed=0, index=0, mix="single", plants=["finger"], kinds=["payload"])
