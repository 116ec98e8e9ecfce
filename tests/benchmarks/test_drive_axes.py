"""The drive axes' equations against closed forms; their sets: the same from a seed, readable."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from scipy import special

from benchmarks.blind_sets import scoring
from benchmarks.drive_axes import effects, friction, mechanics, plants, recording, sets, simulation
from benchmarks.drive_axes.simulation import STEP
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.suite.effects.registry import KINDS

TICK = 10
RUBS = ("dry", "breakaway", "viscous", "of_load", "error", "encoder_noise")


def ideal(plant, *, driven=False, seed=5):
  """Returns a machine without friction, which only its drive damps."""
  machine = plants.on_paper(plant, np.random.default_rng(seed))
  none = {name: np.zeros_like(machine.axes.gain) for name in RUBS}
  none |= {"damping": machine.axes.damping if driven else 0.0 * machine.axes.damping}
  if not driven:
    none["speed_gain"] = 0.0 * machine.axes.gain
  return dataclasses.replace(machine, axes=machine.axes._replace(**none))


def run(machine, start, seconds):
  """Returns the rows of a run whose goals [n] stay where it starts."""
  of = mechanics.coefficients(machine.plant, machine.links)
  goals = np.tile(np.asarray(start, float), (round(seconds / (TICK * STEP)), 1))
  return simulation.simulate(machine.axes, of, goals, np.zeros_like(goals), TICK, 0.0)


def test_an_undriven_carriage_falls_as_its_rotor_lets_it():
  machine = ideal("lift")
  link = run(machine, [0.0], 1.0)[:, 0, simulation.LINK]
  mass, rotor = machine.links.mass[0], machine.axes.rotor[0]
  acceleration = mechanics.GRAVITY * mass / (mass + rotor)
  time = np.arange(link.size) * TICK * STEP
  np.testing.assert_allclose(link[500:], -0.5 * acceleration * time[500:] ** 2, rtol=1e-3)


def test_an_undriven_swivel_on_its_side_has_the_period_of_the_elliptic_integral():
  machine = ideal("swing")
  links = machine.links._replace(tilt=np.array([-0.5 * math.pi, 0.0]))  # along -y
  machine = dataclasses.replace(machine, links=links)
  away = 1.0
  link = run(machine, [away - 0.5 * math.pi], 12.0)[:, 0, simulation.LINK] + 0.5 * math.pi
  moment = links.mass[0] * links.centre[0]
  inertia = links.inertia[0] + links.mass[0] * links.centre[0] ** 2 + machine.axes.rotor[0]
  slow = 4.0 * math.sqrt(inertia / (moment * mechanics.GRAVITY))
  expected = slow * special.ellipk(math.sin(0.5 * away) ** 2)
  up = np.flatnonzero((link[:-1] < 0) & (link[1:] >= 0))
  assert np.diff(up).mean() * TICK * STEP == pytest.approx(expected, rel=3e-3)


def test_an_undriven_planar_arm_keeps_its_energy():
  machine = ideal("planar")
  rows, links = run(machine, [1.3, -0.6], 5.0), machine.links
  q, v = rows[:, :, simulation.LINK], rows[:, :, simulation.LINK_SPEED]
  turned, rate = np.cumsum(q, 1), np.cumsum(v, 1)
  tips = [links.length[0] * np.array([-np.sin(turned[:, 0]), -np.cos(turned[:, 0])])]
  moving = links.length[0] * rate[:, 0] * np.array([-np.cos(turned[:, 0]), np.sin(turned[:, 0])])
  energy = 0.0
  for j, (origin, drift) in enumerate([(0.0 * tips[0], 0.0 * moving), (tips[0], moving)]):
    c, angle = links.centre[j], turned[:, j]
    place = origin + c * np.array([-np.sin(angle), -np.cos(angle)])
    speed = drift + c * rate[:, j] * np.array([-np.cos(angle), np.sin(angle)])
    energy = energy + 0.5 * links.mass[j] * (speed**2).sum(0)
    energy = energy + 0.5 * links.inertia[j] * rate[:, j] ** 2
    energy = energy + links.mass[j] * mechanics.GRAVITY * place[1]
    twist = rows[:, j, simulation.ROTOR] - q[:, j]
    energy = energy + 0.5 * machine.axes.rotor[j] * rows[:, j, simulation.ROTOR_SPEED] ** 2
    energy = energy + 0.5 * machine.axes.stiffness[j] * twist**2
  assert np.ptp(q[:, 0]) > 1.0
  assert np.ptp(energy) < 2e-3 * np.ptp(links.mass[0] * links.centre[0] * 9.81 * np.cos(q[:, 0]))


def test_accelerations_are_those_of_mujoco():
  random = np.random.default_rng(3)
  machine = ideal("planar")
  none = machine.axes._replace(rotor=np.full(2, 1e-12))
  xml = plants.declared(dataclasses.replace(machine, axes=none))
  model = mujoco.MjModel.from_xml_string(xml)
  data = mujoco.MjData(model)
  of, out = mechanics.coefficients("planar", machine.links), np.zeros(2)
  for _ in range(5):
    data.qpos[:], data.qvel[:] = random.uniform(-1.5, 1.5, (2, 2))
    torque = random.uniform(-3.0, 3.0, 2)
    mujoco.mj_forward(model, data)
    data.qfrc_applied[:] = torque - data.qfrc_actuator
    mujoco.mj_forward(model, data)
    mechanics.accelerate(of, data.qpos.copy(), data.qvel.copy(), torque, out)
    np.testing.assert_allclose(out, data.qacc, rtol=2e-5)


def test_a_carriage_hangs_below_its_goal_by_what_a_leaky_integral_leaves():
  machine = ideal("lift", driven=True)
  axes = machine.axes
  reading = run(machine, [0.1], 8.0)[-1, 0, simulation.READING]
  weight = mechanics.GRAVITY * machine.links.mass[0]
  stiffness = axes.position_gain[0] * axes.speed_gain[0]
  boosted = stiffness * (1.0 + axes.leak[0] / axes.integral_time[0])
  assert 0.1 - reading == pytest.approx(weight / boosted, abs=2e-5)


def test_friction_at_rest_holds_what_is_less_and_slides_at_what_is_more():
  forces, moved = np.zeros(friction.SHARES.size), 1e-6
  held = [friction.slip(forces, moved, 2.0, 1e-3, 2.0) for _ in range(5000)]
  assert held[0] < 0.02
  assert held[-1] == pytest.approx(2.0)
  turned = [friction.slip(forces, -moved, 2.0, 1e-3, 2.0) for _ in range(8000)]
  assert np.all(np.diff(turned) <= 1e-12)  # hysteresis: twice the way to slide back
  assert turned[3000] > -2.0 + 1e-3 and turned[-1] == pytest.approx(-2.0)


def test_the_kinds_are_the_librarys_and_others():
  assert len(effects.LIBRARY) >= 12 and len(effects.OUTSIDE) >= 6
  assert set(effects.LIBRARY) <= set(KINDS)
  assert not set(effects.OUTSIDE) & set(KINDS)


@pytest.mark.parametrize("name", [*effects.LIBRARY, *effects.OUTSIDE])
def test_every_kind_changes_what_is_read_and_has_the_librarys_parameters(name):
  kind = {**effects.LIBRARY, **effects.OUTSIDE}[name]
  random = np.random.default_rng(11)
  machine = plants.on_paper(kind.plants[-1], random)
  host = recording.draw_host(random)
  broken = kind.apply(machine, host, len(machine.joints) - 1, 1.0, random.random(4))
  times = recording.command_times(host, 4.0)
  commands = 0.6 * np.outer(np.sin(4.0 * times), [reach.amplitude for reach in machine.reach])
  logs = [
    recording.record(m, h, commands, np.random.default_rng(1))
    for m, h in ((machine, host), (broken.machine, broken.host))
  ]
  shift = [np.interp(logs[0].time, log.stamp, log.position[:, -1]) for log in logs]
  assert np.sqrt(np.mean((shift[1] - shift[0]) ** 2)) > 1e-3
  if name in effects.LIBRARY:
    assert set(broken.parameters) <= {parameter.name for parameter in KINDS[name].parameters}
    assert set(broken.parameters) & set(scoring.SIZES[name])


def test_a_set_is_determined_by_its_seed_and_its_logs_open(tmp_path):
  options = {"seed": 499, "index": 1, "mix": "single", "plants": ["planar"]}
  options |= {"kinds": ["viscous_friction"], "same_day": True}
  answer = sets.make_set(tmp_path / "a", **options).answer
  assert sets.make_set(tmp_path / "b", **options).answer == answer
  names = [f"train_{name}" for name in ("1_sweep", "2_slow", "3_ramps")]
  names += [name.replace("train", "reference") for name in names] + [
    "held_1_points",
    "held_2_wander",
  ]
  assert sorted(path.stem for path in (tmp_path / "a").glob("*.mcap")) == sorted(names)
  for name in names:
    path = f"{name}.mcap"
    assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()
    log = read_log(tmp_path / "a" / path)
    assert log.joints == plants.JOINTS["planar"]
    assert 9.5 < log.duration < 14.5
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "a" / "model.xml"))
  assert model.njnt == model.nu == 2
  assert not answer["below_floor"] and answer["error_ratio"] >= sets.LEAST_RATIO - 0.01
  assert answer["effects"][0]["joint"] in plants.JOINTS["planar"]


def test_choices_that_are_not_there_are_refused(tmp_path):
  with pytest.raises(ValueError, match="trampoline"):
    sets.make_set(tmp_path, seed=0, index=0, plants=["trampoline"])
  with pytest.raises(ValueError, match="gravity_tilt"):
    sets.make_set(tmp_path, seed=0, index=0, mix="single", plants=["lift"], kinds=["gravity_tilt"])
