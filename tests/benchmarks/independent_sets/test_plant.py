"""The second generator's physics against conservation, hand computation, scipy and MuJoCo."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from benchmarks.independent_sets import apparatus, bodies, drives, friction, machine, simulation

STEP = simulation.STEP


def paper(plant, seed=3):
  return apparatus.make_apparatus(plant, np.random.default_rng(seed))


def ideal(nominal, **more):
  """Returns a machine without friction, with a gear all but rigid and an encoder all but exact."""
  none = np.zeros_like(nominal.rotor)
  lightest = np.minimum(nominal.rotor, nominal.mass if nominal.slides else nominal.inertia)
  stiffness = lightest * (2 * np.pi * 150.0) ** 2
  lost = dict.fromkeys(("viscous", "coulomb", "stribeck", "dead_band"), none)
  damping = 0.1 * np.sqrt(stiffness * lightest)
  gear = {"gear_stiffness": stiffness, "gear_damping": damping}
  return nominal.change(**lost, **gear, count=none + 1e-9, current_time=none + 2e-4, **more)


def run(nominal, start, *, duration, mode, commands, sent=(0,), tick=5):
  return simulation.simulate(
    machine.stack([nominal]),
    mode=mode,
    start=np.array([start], float),
    sent=np.asarray(sent),
    commands=np.asarray(commands, float)[:, None],
    steps=round(duration / STEP),
    tick=tick,
  )


@pytest.mark.parametrize("plant", apparatus.KINDS)
def test_accelerations_are_mujocos(plant):
  made = paper(plant)
  model = mujoco.MjModel.from_xml_string(made.xml)
  model.dof_damping[:] = model.dof_frictionloss[:] = 0
  data, rng = mujoco.MjData(model), np.random.default_rng(0)
  batch = machine.stack([made.nominal])
  accelerate = bodies.carriage if made.nominal.slides else bodies.chain
  for _ in range(10):
    data.qpos[:], data.qvel[:] = rng.normal(size=(2, model.nv))
    data.qfrc_applied[:] = rng.normal(size=model.nv)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0
    mujoco.mj_forward(model, data)
    # MuJoCo's rotors turn with the links.
    force = data.qfrc_applied - made.nominal.rotor * data.qacc
    got = accelerate(batch, data.qpos[None], data.qvel[None], force[None])[0]
    np.testing.assert_allclose(got, data.qacc, rtol=1e-6, atol=1e-6)


def _energy(machine, q, v):
  """Returns kinetic and potential energy [B] J of the links, without rotors and gears."""
  if machine.slides:
    height = q * np.sin(machine.tilt)
    total = machine.mass * (0.5 * v**2 + machine.gravity * height)
    return total[:, 0]
  angles = np.cumsum(q, axis=1) + machine.tilt
  height = -machine.moment_x * np.sin(angles) + machine.moment_z * np.cos(angles)
  rates = np.cumsum(v, axis=1)
  total = 0.5 * machine.inertia * rates**2 + machine.gravity * height
  if q.shape[1] == 1:
    return total[:, 0]
  length, mass = machine.length[:, 0], machine.mass[:, 1]
  x, z = machine.moment_x[:, 1], machine.moment_z[:, 1]
  coupling = length * (x * np.sin(q[:, 1]) - z * np.cos(q[:, 1]))
  shared = 0.5 * mass * (length * rates[:, 0]) ** 2 + coupling * rates[:, 0] * rates[:, 1]
  tip = -machine.gravity[:, 0] * mass * length * np.cos(angles[:, 0])
  return total.sum(axis=1) + shared + tip


@pytest.mark.parametrize("plant", ["arm", "wheel"])
def test_energy_is_conserved(plant):
  batch = machine.stack([paper(plant).nominal])
  n = batch.rotor.shape[1]

  def rates(t, y):
    a = bodies.chain(batch, y[None, :n], y[None, n:], np.zeros((1, n)))[0]
    return np.concatenate([y[n:], a])

  start = np.concatenate([np.full(n, 1.2), np.full(n, -0.5)])
  path = solve_ivp(rates, (0, 3), start, rtol=1e-10, atol=1e-12).y
  many = machine.stack([paper(plant).nominal] * path.shape[1])
  energy = _energy(many, path[:n].T, path[n:].T)
  assert np.ptp(path[0]) > 1.0
  assert np.ptp(energy) < 1e-7 * np.abs(energy).max()


def test_a_pendulum_has_its_period_and_keeps_its_height():
  nominal = ideal(paper("wheel").nominal)
  nominal = nominal.change(torque_constant=np.zeros(1), moment_x=np.zeros(1))
  swing = run(nominal, [1.0], duration=6.0, mode="servo", commands=[[0.0]]).link[:, 0, 0]
  small = (
    2 * np.pi * np.sqrt((nominal.inertia + nominal.rotor) / (-nominal.moment_z * nominal.gravity))
  )
  period = small[0] * 2 / np.pi * ellipk(np.sin(0.5) ** 2)
  crossings = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
  assert np.diff(crossings).mean() * STEP == pytest.approx(period, rel=1e-3)
  assert swing[crossings[-2] : crossings[-1]].max() == pytest.approx(1.0, rel=1e-3)


def test_a_screw_turns_torque_into_force():
  made = paper("slider")
  nominal = ideal(made.nominal, tilt=np.zeros(1))
  force = 0.3 * nominal.torque_constant * nominal.current_limit
  path = run(nominal, [0.0], duration=0.2, mode="current", commands=[force]).link[:, 0, 0]
  # Torque on the nut is force times the lead over a turn, so the rotor weighs as J / (lead/2 pi)^2.
  expected = 0.5 * force[0] / (nominal.mass + nominal.rotor)[0] * 0.2**2
  assert path[-1] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("plant", apparatus.KINDS)
def test_a_frictionless_machine_moves_as_mujoco_says(plant):
  made = paper(plant)
  nominal = ideal(made.nominal)
  if plant == "wheel":
    nominal = nominal.change(inductance=nominal.resistance * 5e-5)
  if plant == "slider":
    nominal = nominal.change(rate_filter=np.full(1, 1e-5))
  model = mujoco.MjModel.from_xml_string(made.xml)
  model.dof_frictionloss[:] = 0
  model.dof_damping[:] -= made.nominal.viscous
  model.opt.timestep = STEP
  size = 0.2 * made.amplitude
  if plant == "arm":  # torques, at rest against gravity
    size = 0.05 * made.nominal.torque_constant * made.nominal.current_limit
  sent = np.arange(0, 5000, 50)
  wave = np.sin(2 * np.pi * 1.3 * sent * STEP)[:, None] * size
  path = run(nominal, 0 * size, duration=1.0, mode=made.mode, commands=wave, sent=sent, tick=1)
  data = mujoco.MjData(model)
  expected = np.zeros((5000, model.nq))
  for index in range(5000):
    expected[index] = data.qpos
    data.ctrl[:] = wave[index // 50]
    mujoco.mj_step(model, data)
  assert np.ptp(expected, axis=0).min() > 1e-3
  error = np.sqrt(np.mean((path.link[:, 0] - expected) ** 2, axis=0))
  assert (error < 0.01 * np.ptp(expected, axis=0)).all()


def rig(**values):
  base = {"coulomb": 0.1, "presliding": 1e-3, "fall": 0.0, "dwell_friction": 0.0}
  arrays = {name: np.full((1, 1), value) for name, value in (base | values).items()}
  return machine.stack([paper("wheel").nominal]).change(**arrays)


def test_friction_springs_then_slides_and_remembers_reversals():
  made = friction.Friction(rig())
  slide = np.full((1, 1), 0.1)

  def push(distance):
    for _ in range(1000):
      made.advance(np.full((1, 1), distance / 1000), slide, step=STEP)
    return float(made.force.sum())

  first = push(1e-4)
  stiffness = (friction.SHARES / friction.REACHES).sum() * 0.1 / 1e-3
  assert first == pytest.approx(stiffness * 1e-4, rel=1e-6)  # nothing slides yet
  assert push(2e-3) == pytest.approx(0.1)
  assert push(-4e-3) == pytest.approx(-0.1)
  # A small loop inside closes: from the same place back to it by the same force.
  here = push(5e-4)
  push(-3e-4)
  assert push(3e-4) == pytest.approx(here, rel=1e-6)


def test_friction_grows_at_rest_and_in_a_patch():
  made = friction.Friction(rig(dwell_friction=0.2, dwell_time=0.5))
  still = np.zeros((1, 1))
  for _ in range(5000):  # 1 s
    made.advance(still, np.full((1, 1), 0.1), step=STEP)
  assert made.steady(still, still)[0, 0] == pytest.approx(0.1 + 0.2 * (1 - np.exp(-2)), rel=1e-3)
  for _ in range(500):
    made.advance(np.full((1, 1), 1e-4), np.full((1, 1), 0.1), step=STEP)
  assert made.steady(still, still)[0, 0] < 0.12
  patch = friction.Friction(rig(patch_depth=3.0, patch_place=0.4, patch_width=0.1))
  assert patch.steady(np.full((1, 1), 0.4), still)[0, 0] == pytest.approx(0.4)
  assert patch.steady(np.full((1, 1), 0.9), still)[0, 0] == pytest.approx(0.1, rel=1e-6)


def test_a_servo_gives_the_declared_torque_but_for_dead_band_limit_and_supply():
  made = paper("wheel")
  m = machine.stack([made.nominal])
  stall = (m.torque_constant * m.volts / m.resistance).item()

  def stalled(batch, error):
    drive, zero = drives.Drive(batch, "servo", step=STEP), np.zeros((1, 1))
    drive.tick(np.full((1, 1), error), zero, zero, period=1e-3)
    for _ in range(500):
      torque = drive.advance(zero, time=0.0)
    return torque.item()

  full = 1 / m.servo_gain.item()
  band = m.dead_band.item()
  assert stalled(m, 0.5 * full) == pytest.approx(stall * (0.5 - band) / (1 - band), rel=1e-6)
  assert stalled(m, 0.9 * band * full) == 0.0
  assert stalled(m.change(duty_limit=np.full((1, 1), 0.4)), full) == pytest.approx(
    stall * (0.4 - band) / (1 - band)
  )
  droop = 0.5 / stall
  ohms = np.full((1, 1), droop * (m.volts * m.torque_constant).item())
  # strength = 1 - droop torque, solved for the torque.
  assert stalled(m.change(supply_resistance=ohms), full) == pytest.approx(stall / 1.5, rel=1e-3)


def test_play_lets_the_link_hang_at_one_side():
  nominal = paper("wheel").nominal
  gap = 0.03
  nominal = nominal.change(half_gap=np.full(1, gap / 2), coulomb=np.full(1, 10.0))
  trace = run(nominal, [0.6], duration=2.0, mode="servo", commands=[[0.6]])
  # Friction holds the rotor; the link falls to the end of the gap and winds the gear up a little.
  assert trace.link[-1, 0, 0] == pytest.approx(0.6 - gap / 2, abs=0.3 * gap)
  assert trace.link[-1, 0, 0] < 0.6 - gap / 2
