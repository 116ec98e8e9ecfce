"""The bench's equations against closed forms, and against MuJoCo."""

import math

import mujoco
import numpy as np
import pytest
from scipy import special

from benchmarks.servo_bench import (
  arm,
  bench,
  effects,
  following,
  friction,
  gear,
  loop,
  motor,
  recording,
  simulation,
)
from nerf2real.suite.effects import Effect, EffectStack

FAR = 10**7  # counts


@pytest.fixture(scope="module")
def ideal():
  """A hanging arm without friction, play or errors of its encoder; closed teeth do not damp."""
  paper = bench.on_paper("hanging", np.random.default_rng(5))
  b = paper.bench
  finer = 2**17 / b.loop.counts
  return paper._replace(
    bench=b._replace(
      friction=b.friction._replace(coulomb=0.0, breakaway=0.0, viscous=0.0, load=0.0, damping=0.0),
      gear=b.gear._replace(play=0.0, damping=0.0),
      motor=b.motor._replace(heat_capacity=1e9),
      loop=b.loop._replace(
        noise=0.0, dead_band=0, rate_gain=0, counts=2**17, gain=round(b.loop.gain / finer)
      ),
      arm=b.arm._replace(ripple=0.0),
    )
  )


def run(machine, goals, seconds, lead=0.0):
  """Returns the rows of a run with goals at times: [(s, counts), ...]."""
  times, counts = zip(*goals, strict=True)
  noise = np.zeros(round(1000 * seconds))
  return simulation.simulate(
    machine, np.array(times, float), np.array(counts, np.int64), noise, lead
  )


def swinging(machine):
  """Returns a bench whose motor is not connected."""
  return machine._replace(
    motor=machine.motor._replace(resistance=1e12), loop=machine.loop._replace(gain=0)
  )


def counts_of(machine, angle):
  return round(angle * machine.loop.counts / math.tau)


def crossings(x):
  """Returns where a signal crosses 0 upwards, in samples, interpolated."""
  k = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
  return k - x[k] / (x[k + 1] - x[k])


def test_a_free_pendulum_has_the_period_of_the_elliptic_integral(ideal):
  machine = swinging(ideal.bench)
  a = machine.arm
  start = 1.0
  rows = run(machine, [(0.0, counts_of(machine, start))], 10.0)
  inertia = a.inertia + machine.gear.rotor
  small = math.sqrt(inertia / (-a.moment_1 * bench.GRAVITY))
  expected = 4 * small * special.ellipk(math.sin(start / 2) ** 2)
  period = np.diff(crossings(rows[:, simulation.ANGLE])).mean() * 1e-3
  assert period == pytest.approx(expected, rel=2e-3)


def test_a_free_pendulum_keeps_its_energy(ideal):
  machine = swinging(ideal.bench)
  a, g = machine.arm, machine.gear
  rows = run(machine, [(0.0, counts_of(machine, 1.2))], 10.0)
  angle, speed = rows[:, simulation.ANGLE], rows[:, simulation.SPEED]
  rotor, rotor_speed = rows[:, simulation.ROTOR], rows[:, simulation.ROTOR_SPEED]
  energy = 0.5 * a.inertia * speed**2 + 0.5 * g.rotor * rotor_speed**2
  energy += 0.5 * g.stiffness * (rotor - angle) ** 2
  energy += a.moment_1 * bench.GRAVITY * np.cos(angle)  # moment_1 < 0: below the axis
  swing = -a.moment_1 * bench.GRAVITY * (1 - math.cos(1.2))
  assert np.ptp(energy) < 5e-3 * swing


def test_dry_friction_takes_its_share_of_every_swing(ideal):
  # A spring in place of gravity: the amplitude falls by 4 F / k in a period.
  torque, stiffness = 0.01, 2.0
  machine = swinging(ideal.bench)
  machine = machine._replace(
    arm=machine.arm._replace(moment_1=0.0, moment_2=0.0, spring=stiffness),
    friction=machine.friction._replace(coulomb=torque, stiffness=200.0),
    gear=machine.gear._replace(damping=1.0),
  )
  rows = run(machine, [(0.0, counts_of(machine, 0.5))], 5.0)
  angle = rows[:, simulation.ANGLE]
  peaks = angle[1:-1][(angle[1:-1] > angle[:-2]) & (angle[1:-1] >= angle[2:])]
  peaks = peaks[peaks > 0.1]
  assert len(peaks) > 3
  np.testing.assert_allclose(-np.diff(peaks), 4 * torque / stiffness, rtol=0.05)


@pytest.mark.parametrize("speed", [-2.0, -0.05, 0.01, 0.3])
def test_sliding_reaches_the_closed_form_of_lugre(speed):
  f = bench.on_paper("bent", np.random.default_rng(3)).bench.friction
  f = f._replace(breakaway=0.7 * f.coulomb, stribeck_speed=0.1)
  bristle = 0.0
  for _ in range(8_000):
    fall = friction.stribeck(f, speed)
    dry = friction.level(f, speed, 1.5, 0.0, fall)
    bristle = friction.bent(bristle, speed, dry, f.stiffness, 1e-3)
  kinetic = f.coulomb + f.load * 1.5
  expected = kinetic + 0.7 * f.coulomb * math.exp(-((speed / 0.1) ** 2))
  assert f.stiffness * bristle == pytest.approx(math.copysign(expected, speed), rel=1e-6)
  total = math.copysign(expected, speed) + f.viscous * speed
  assert friction.steady(f, speed, 1.5) == pytest.approx(total)


def test_a_bristle_sticks_as_a_spring():
  assert friction.bent(1e-4, 0.0, 0.1, 50.0, 25e-6) == 1e-4
  slow = friction.bent(0.0, 1e-3, 0.1, 50.0, 25e-6)
  assert slow == pytest.approx(1e-3 * 25e-6, rel=1e-4)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_an_unloaded_motor_reaches_its_no_load_speed(ideal, share):
  machine = ideal.bench
  steps = machine.loop.steps
  machine = machine._replace(
    arm=machine.arm._replace(moment_1=0.0, moment_2=0.0),
    loop=machine.loop._replace(limit=round(share * steps)),
  )
  rows = run(machine, [(0.0, 0), (0.01, FAR)], 3.0)
  expected = round(share * steps) / steps * machine.motor.voltage / machine.motor.constant
  assert rows[-1, simulation.SPEED] == pytest.approx(expected, rel=1e-4)
  assert motor.no_load_speed(machine.motor) == pytest.approx(ideal.servo.speed)


def test_a_stalled_motor_holds_its_stall_torque(ideal):
  machine = ideal.bench
  m = machine.motor._replace(source_resistance=0.1 * machine.motor.resistance, heat_capacity=1e9)
  stiffness = 3 * ideal.servo.stall
  machine = machine._replace(
    motor=m, arm=machine.arm._replace(moment_1=0.0, moment_2=0.0, spring=stiffness)
  )
  rows = run(machine, [(0.0, 0), (0.01, FAR)], 3.0)
  torque = stiffness * rows[-1, simulation.ANGLE]
  assert torque == pytest.approx(ideal.servo.stall / 1.1, rel=1e-3)
  assert motor.stall_torque(m) == pytest.approx(torque, rel=1e-3)
  assert rows[-1, simulation.SUPPLY] == pytest.approx(m.voltage / 1.1, rel=1e-3)


def test_the_current_solves_the_circuit():
  m = bench.on_paper("level", np.random.default_rng(1)).bench.motor
  m = m._replace(source_resistance=0.3, fade=0.01)
  duty, speed, rise, time = -0.7, 1.3, 20.0, 5.0
  amperes = motor.current(m, duty, speed, rise, time)
  plug = motor.supply(m, duty, amperes, time)
  assert plug == pytest.approx(m.voltage * 0.95 - 0.3 * duty * amperes)
  winding = m.resistance * (1 + 0.0039 * 20.0)
  assert duty * plug - m.constant * speed == pytest.approx(winding * amperes)


def test_a_winding_warms_to_power_times_thermal_resistance():
  m = bench.on_paper("level", np.random.default_rng(1)).bench.motor
  m = m._replace(heat_capacity=2.0, cooling_time=4.0, resistance=3.0)
  rise = 0.0
  for _ in range(40_000):
    rise = motor.warmed(m, rise, 1.5, 1e-3)
  cold = 3.0 * 1.5**2 * 4.0 / 2.0  # and copper's growth with it: T = cold (1 + a T)
  assert rise == pytest.approx(cold / (1 - 0.0039 * cold), rel=1e-3)


def test_play_remembers_the_flank_that_was_left(ideal):
  gap = 0.03
  machine = ideal.bench
  machine = machine._replace(
    gear=machine.gear._replace(play=gap, damping=1e-3 * machine.gear.stiffness)
  )
  times = np.arange(0.0, 12.0, 0.02)
  wave = 0.5 * np.sin(math.tau * times / 6.0)
  goals = [(t, counts_of(machine, w)) for t, w in zip(times, wave, strict=True)]
  rows = run(machine, goals, 12.0)
  angle, rotor = rows[:, simulation.ANGLE], rows[:, simulation.ROTOR]
  held = -machine.arm.moment_1 * bench.GRAVITY * np.sin(angle)  # what gravity asks of the teeth
  expected = np.sign(angle) * gap / 2 + held / machine.gear.stiffness
  far = np.abs(angle) > 0.2  # nearer to 0 the arm coasts through the gap
  assert np.abs(rotor - angle - expected)[far].max() < 1e-3
  assert np.abs(rotor - angle).max() < gap / 2 + np.abs(held).max() / machine.gear.stiffness + 2e-3


def test_teeth_push_and_never_pull():
  g = gear.Gear(rotor=0.01, play=0.02, stiffness=100.0, damping=1.0)
  assert gear.teeth(g, 0.009, 5.0) == 0.0
  assert gear.teeth(g, 0.03, 0.1) == pytest.approx(2.1)
  assert gear.teeth(g, -0.03, -0.1) == pytest.approx(-2.1)
  assert gear.teeth(g, 0.011, -5.0) == 0.0


def test_the_firmware_counts_as_a_hand_does():
  f = loop.Loop(4096, 800, 300, 885, 400, 1, math.inf, 0.0, 0.0)
  assert loop.duty(f, 10, 0, 0) == 62  # 8000 / 128 = 62.5
  assert loop.duty(f, -10, 0, 0) == -62
  assert loop.duty(f, 1, 0, 0) == 0  # dead band
  assert loop.duty(f, 10, 0, -3) == 55  # (8000 - 900) / 128
  assert loop.duty(f, 1000, 0, 0) == 400
  assert loop.read(f, 0.0015, 0.0) == 1
  assert loop.read(f, -0.0009, 0.0) == -1
  assert loop.approached(f._replace(slew=2.5), 10.0, 100) == 12.5
  assert loop.position_gain(f, 4.1) == pytest.approx(800 / 128 / 885 * 4.1 * 4096 / math.tau)


def test_a_flexible_link_has_the_modes_of_two_masses(ideal):
  machine = swinging(ideal.bench)
  share, frequency, stiffness = 0.6, 40.0, 5.0
  a = machine.arm._replace(
    moment_1=0.0,
    moment_2=0.0,
    spring=stiffness,
    spring_angle=0.1,
    tip_share=share,
    tip_frequency=frequency,
    tip_damping=0.0,
  )
  rows = run(machine._replace(arm=a), [(0.0, 0)], 20.0)
  tip = share * a.inertia
  hub = (1 - share) * a.inertia + machine.gear.rotor
  bar = tip * frequency**2
  modes = np.linalg.eigvals([[(stiffness + bar) / hub, -bar / hub], [-bar / tip, bar / tip]])
  angle = rows[:, simulation.ANGLE]
  spectrum = np.abs(np.fft.rfft((angle - angle.mean()) * np.hanning(angle.size)))
  hertz = np.fft.rfftfreq(angle.size, 1e-3)
  for mode in np.sqrt(modes) / math.tau:
    near = np.abs(hertz - mode) < 0.1 * mode
    assert hertz[near][spectrum[near].argmax()] == pytest.approx(mode, abs=0.06)


@pytest.mark.parametrize("plant", bench.PLANTS)
def test_gravity_is_that_of_the_declared_model(plant):
  paper = bench.on_paper(plant, np.random.default_rng(8))
  model = mujoco.MjModel.from_xml_string(bench.declared(paper, paper.bench))
  assert_same_gravity(model, paper.bench.arm)


def assert_same_gravity(model, a):
  data = mujoco.MjData(model)
  for angle in (-1.0, 0.0, 0.6):
    data.qpos[0] = angle
    mujoco.mj_forward(model, data)
    assert -data.qfrc_bias[0] == pytest.approx(arm.weight(a, angle), rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(
  ("kind", "plant"),
  [("payload", "bent"), ("payload", "turntable"), ("gravity_tilt", "turntable")],
)
def test_masses_and_tilts_are_the_librarys(kind, plant):
  random = np.random.default_rng(9)
  paper = bench.on_paper(plant, random)
  host = recording.draw_host(paper.bench.motor, random)
  machine = effects.Machine(paper, paper.bench, host)
  changed, values = effects.LIBRARY[kind].apply(machine, 0.7, random.random(4))
  numbers = {name: value for name, value in values.items() if name != "body"}
  model = mujoco.MjModel.from_xml_string(bench.declared(paper, paper.bench))
  EffectStack([Effect(kind, values.get("body"), numbers)]).bind(model)
  # sin(t) / t along the tilt is the rotation's; a tilted vertical axis leaves the rest.
  assert_same_gravity(model, changed.bench.arm)
  data, whole = mujoco.MjData(model), np.zeros((1, 1))
  mujoco.mj_forward(model, data)
  mujoco.mj_fullM(model, data, whole)
  inertia = changed.bench.arm.inertia + changed.bench.gear.rotor
  assert whole[0, 0] == pytest.approx(inertia, rel=1e-3)


def test_a_bench_without_imperfections_moves_as_mujoco(ideal):
  machine = ideal.bench._replace(gear=ideal.bench.gear._replace(damping=0.5))
  host = recording.draw_host(machine.motor, np.random.default_rng(2))
  host = host._replace(latency=0.0, age=0.0, jitter=0.0)
  times = recording.command_times(host, 6.0)
  command = 0.6 * np.sin(math.tau * 0.8 * times) * np.minimum(times, 1.0)
  log = recording.record(machine, host, command, np.random.default_rng(2))
  xml = bench.declared(ideal, machine)
  course = following.follow(xml, log.command_time, command, recording.lateness(host))
  assert following.error(course, log) < 1.5e-3
