"""The blind sets' plant is right, clean machines fit their models, and truth is what is written."""

import copy
import functools
import hashlib
import json
import pathlib
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from benchmarks import make_blind_sets
from benchmarks.blind_sets import apparatus as apparatuses
from benchmarks.blind_sets import effects, machine, plant, recording, rigid_body, sets
from nerf2real.core.robot_logs import reading as logs
from nerf2real.sysid.data import compatibility

GRAVITY = np.array([0.0, 0.0, -9.81])


def _clean(apparatus, *, ticks_per_second):
  """Returns perfect servos with the declared constants, and a world without rounding."""
  model = apparatus.model
  limit = model.actuator_forcerange[:, 1]
  counts, full = 1e6, 10**7
  servo = plant.make_servos(
    model.njnt,
    motor_inertia=0.98 * model.dof_armature,
    output_inertia=0.02 * model.dof_armature,
    viscous=model.dof_damping,
    coulomb=model.dof_frictionloss,
    stall=limit,
    register=model.actuator_gainprm[:, 0] / limit * full / counts * plant.REGISTER_ONE,
    duty_limit=full,
  )
  world = plant.World(GRAVITY, 12.0, 0.0, 0.0, counts, full, ticks_per_second)
  return servo, world


def _run(apparatus, servo, world, commands, period, duration, tree=None):
  ticks = round(duration * world.ticks_per_second)
  trace = plant.simulate(
    tree or rigid_body.read_tree(apparatus.model),
    servo,
    world=world,
    start_angles=commands[0],
    arrivals=np.arange(len(commands)) * period,
    commands=commands,
    start=0.0,
    ticks=ticks,
    step=apparatus.step,
    encoder_noise=np.zeros((ticks, commands.shape[1])),
  )
  return trace.position / world.counts_per_radian, trace


@pytest.mark.parametrize("kind", apparatuses.KINDS)
def test_rigid_bodies_agree_with_mujoco(kind):
  model = apparatuses.make_apparatus(kind, np.random.default_rng(3)).model
  tree, work, data = (
    rigid_body.read_tree(model),
    rigid_body.make_work(model.nv),
    mujoco.MjData(model),
  )
  rng = np.random.default_rng(0)
  for _ in range(3):
    q, qd = rng.normal(size=model.nv), 3 * rng.normal(size=model.nv)
    data.qpos[:], data.qvel[:] = q, qd
    mujoco.mj_forward(model, data)
    torque = work.bias.copy()
    rigid_body.dynamics(tree, q, qd, GRAVITY, work)
    np.testing.assert_allclose(work.bias, data.qfrc_bias, atol=1e-12)
    torque = rng.normal(size=model.nv)
    product = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, product, torque)
    np.testing.assert_allclose(
      work.matrix @ torque + model.dof_armature * torque, product, atol=1e-12
    )
    matrix, right = work.matrix + 0.01 * np.eye(model.nv), torque.copy()
    expected = np.linalg.solve(matrix, torque)
    rigid_body.solve(tree.parent, matrix.copy(), right)
    np.testing.assert_allclose(right, expected, rtol=1e-9, atol=1e-12)


def _energy(tree, q, qd, gravity):
  """Returns kinetic plus potential energy, J, from centres of mass and spins (not the matrix)."""
  work = rigid_body.make_work(len(q))
  rigid_body.dynamics(tree, q, qd, gravity, work)
  total = 0.0
  for i in range(len(q)):
    rotation, spin = work.rotation[i], work.velocity[i, :3]
    place = work.position[i] + rotation @ tree.center[i]
    speed = work.velocity[i, 3:] + np.cross(spin, place)
    turning = rotation @ tree.inertia[i] @ rotation.T
    total += 0.5 * tree.mass[i] * speed @ speed + 0.5 * spin @ turning @ spin
    total -= tree.mass[i] * gravity @ place
  return float(total)


def test_a_free_arm_keeps_its_energy():
  model = apparatuses.make_apparatus("arm", np.random.default_rng(5)).model
  tree, work = rigid_body.read_tree(model), rigid_body.make_work(model.nv)

  def acceleration(q, qd):
    rigid_body.dynamics(tree, q, qd, GRAVITY, work)
    return np.linalg.solve(work.matrix, -work.bias)

  q, qd, h = np.full(model.nv, 0.7), np.full(model.nv, -1.0), 2e-3
  start = _energy(tree, q, qd, GRAVITY)
  reached = []
  for _ in range(500):  # classical Runge-Kutta
    k1 = acceleration(q, qd)
    k2 = acceleration(q + h / 2 * qd, qd + h / 2 * k1)
    k3 = acceleration(q + h / 2 * qd + h * h / 4 * k1, qd + h / 2 * k2)
    k4 = acceleration(q + h * qd + h * h / 2 * k2, qd + h * k3)
    q = q + h * qd + h * h / 6 * (k1 + k2 + k3)
    qd = qd + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    reached.append(_energy(tree, q, qd, GRAVITY))
  kinetic = max(reached) - _energy(tree, q, np.zeros_like(qd), GRAVITY)
  assert kinetic > 0.03  # J
  np.testing.assert_allclose(reached, start, atol=1e-6)


def test_a_payload_is_a_point_mass():
  arm = apparatuses.make_apparatus("arm", np.random.default_rng(5))
  place, mass, body = np.array([0.03, -0.02, -0.05]), 0.13, 1
  tree = rigid_body.attach_point_mass(rigid_body.read_tree(arm.model), body, mass, place)
  spec = mujoco.MjSpec.from_string(arm.xml)
  added = spec.body("elbow_link").add_body(pos=place)
  added.mass, added.inertia, added.explicitinertial = mass, np.full(3, 1e-12), True
  added.ipos = np.zeros(3)
  model = spec.compile()
  data, work = mujoco.MjData(model), rigid_body.make_work(model.nv)
  data.qpos[:], data.qvel[:] = 0.4, 1.1
  mujoco.mj_forward(model, data)
  rigid_body.dynamics(tree, data.qpos, data.qvel, GRAVITY, work)
  np.testing.assert_allclose(work.bias, data.qfrc_bias, atol=1e-9)


@pytest.mark.parametrize("kind", ["pendulum", "arm"])
def test_a_clean_machine_moves_as_its_model(kind):
  """All effects off and no rounding: own equations against MuJoCo's, whole log, closed loop."""
  apparatus = apparatuses.make_apparatus(kind, np.random.default_rng(2))
  servo, world = _clean(apparatus, ticks_per_second=round(1 / apparatus.step))
  period, duration = 0.02, 4.0
  time = np.arange(0, duration, period)
  wave = np.sin(2 * np.pi * (0.3 * time + 0.25 * time**2))[:, None]
  commands = apparatus.center + apparatus.amplitude * wave
  ours, _ = _run(apparatus, servo, world, commands, period, duration)
  model = apparatus.model
  model.opt.timestep = apparatus.step
  data = mujoco.MjData(model)
  data.qpos[:] = commands[0]
  theirs = np.zeros_like(ours)
  for index in range(len(ours)):
    theirs[index] = data.qpos
    data.ctrl[:] = commands[int(index * apparatus.step / period + 1e-9)]
    mujoco.mj_step(model, data)
  assert np.ptp(theirs) > 0.8
  error = ours - theirs
  assert np.sqrt(np.mean(error**2)) < 1e-3 and np.abs(error).max() < 4e-3


def test_play_lets_the_link_hang_within_its_gap():
  """A motor held still: the link rests against one side of the gap, half of it below."""
  apparatus = apparatuses.make_apparatus("pendulum", np.random.default_rng(2))
  servo, world = _clean(apparatus, ticks_per_second=1000)
  servo.gap[:], servo.encoder_on_motor[:] = 0.04, 1.0
  servo.coulomb[:] = 5.0  # the motor does not move
  commands = np.full((2, 1), 0.8)
  sensed, _ = _run(apparatus, servo, world, commands, 0.02, 1.0)
  servo.encoder_on_motor[:] = 0.0
  servo.register[:] = 0.0
  hanging, _ = _run(apparatus, servo, world, commands, 0.02, 1.0)
  np.testing.assert_allclose(sensed[-1], 0.8, atol=2e-3)
  np.testing.assert_allclose(hanging[-1], 0.8 - 0.02, atol=2e-3)


def test_friction_holds_and_then_slips_at_its_level():
  """Torque ramps up against gravity-free dry friction: it slips where the torque passes it."""
  apparatus = apparatuses.make_apparatus("pendulum", np.random.default_rng(2))
  servo, world = _clean(apparatus, ticks_per_second=1000)
  world = world._replace(gravity=np.zeros(3))
  servo.coulomb[:], servo.breakaway[:], servo.stribeck_velocity[:] = 0.2, 0.15, 0.05
  gain = apparatus.model.actuator_gainprm[0, 0]
  ramp = np.linspace(0, 0.5, 500)[:, None] / gain
  angles, _ = _run(apparatus, servo, world, ramp, 0.01, 5.0)
  slipped = int(np.argmax(angles[:, 0] > 2e-3))
  torque = gain * (ramp[slipped // 10, 0] - 2e-3)
  assert 0.3 < torque < 0.4  # 0.35 N m, less than that times the bristle's creep


def test_heat_and_supply_weaken_the_motor_as_written():
  apparatus = apparatuses.make_apparatus("pendulum", np.random.default_rng(2))
  servo, world = _clean(apparatus, ticks_per_second=1000)
  world = world._replace(fade=0.05)
  servo.heating[:], servo.cooling_time[:], servo.derating[:] = 2.0, 1e6, 0.004
  servo.coulomb[:] = 20.0  # stalled: the drive is constant but for its weakening
  commands = np.full((2, 1), 0.5)
  commands[0] = 0.4
  _, trace = _run(apparatus, servo, world, commands, 0.001, 4.0)
  rise = trace.temperature_rise[:, 0]
  gain = apparatus.model.actuator_gainprm[0, 0]
  time = np.arange(len(rise)) / 1000
  expected = gain * 0.1 * (1 - 0.05 * time) * (1 - 0.004 * rise)
  np.testing.assert_allclose(trace.effort[100:, 0], expected[100:], rtol=2e-3)
  heated = 2.0 * np.cumsum(trace.effort[:, 0] ** 2) / 1000
  np.testing.assert_allclose(rise[1000:], heated[1000:], rtol=5e-3)
  np.testing.assert_allclose(trace.volts[-1], 12 * (1 - 0.05 * 4), rtol=1e-3)


@functools.cache
def _recorded(name):
  """Returns a healthy machine and what is recorded of it in three seconds."""
  rng = np.random.default_rng(4)
  apparatus = apparatuses.make_apparatus(name, rng)
  reading = machine.draw_reading(rng)
  healthy = machine.build_machine(apparatus, rng)
  time = np.arange(0, 3.0, reading.command_period)
  wave = np.sin(2 * np.pi * (0.5 * time + 0.2 * time**2))[:, None]
  commands = apparatus.center + apparatus.amplitude * wave
  before = recording.record(apparatus, healthy, reading, commands=commands, seed=(1,))
  return apparatus, reading, healthy, commands, before


@pytest.mark.parametrize("kind", sorted(effects.MAKERS))
def test_every_effect_changes_what_is_recorded(kind):
  """An effect at the top of its range moves a recording beyond the encoder's steps."""
  name = effects.MAKERS[kind].plants[0]
  apparatus, reading, healthy, commands, before = _recorded(name)
  rng = np.random.default_rng(4)
  effect = effects.draw_effect(kind, rng, joint=0, center=float(apparatus.center[0]))
  while effects.make_stronger(effect, 2.0):
    pass
  changed = copy.deepcopy(healthy)
  effect.apply(changed)
  after = recording.record(apparatus, changed, reading, commands=commands, seed=(1,))
  if kind == "clock_drift":
    rate = np.polyfit(before.stamp, after.stamp, 1)[0] - 1
    assert rate == pytest.approx(effect.parameters["rate"])
    return
  moved = np.abs(after.position - before.position)[:, 0]
  assert moved.max() > 3 / plant.COUNTS_PER_RADIAN


def test_a_measurement_delay_shifts_positions_and_not_efforts():
  rng = np.random.default_rng(4)
  apparatus = apparatuses.make_apparatus("pendulum", rng)
  reading = machine.Reading(
    stale=0.0,
    encoder_noise=0.0,
    velocity_noise=0.0,
    effort_noise=0.0,
    read_jitter=0.0,
    stamp_jitter=0.0,
  )
  late = machine.build_machine(apparatus, rng)
  prompt = copy.deepcopy(late)
  effects.Drawn("measurement_delay", 0, {"delay": 0.03}).apply(late)
  time = np.arange(0, 4.0, reading.command_period)
  commands = apparatus.center + 0.6 * np.sin(2 * np.pi * 0.7 * time)[:, None]
  now = recording.record(apparatus, prompt, reading, commands=commands, seed=(1,))
  then = recording.record(apparatus, late, reading, commands=commands, seed=(1,))
  np.testing.assert_array_equal(then.position[10:], now.position[7:-3])
  np.testing.assert_array_equal(then.effort, now.effort)


def test_sets_are_what_their_seed_says(tmp_path):
  """Same seed and index: the same bytes, references or not; the logs fit the declared model."""

  def digest(folder):
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir())}

  options = {"seed": 9, "mix": "single", "plants": ("pendulum",), "kinds": ("viscous_friction",)}
  first = sets.make_set(tmp_path / "a", index=0, reference=True, **options)
  again = sets.make_set(tmp_path / "b", index=0, **options)
  made, repeated = digest(tmp_path / "a"), digest(tmp_path / "b")
  assert first == again and repeated.items() < made.items()
  (effect,) = first.answer["effects"]
  assert effect["kind"] == "viscous_friction" and effect["joint"] == "joint"
  assert 0.2 <= effect["coefficient"] <= 1.2
  assert first.answer["error_ratio"] > 1.5
  names = {path.stem for path in (tmp_path / "a").glob("*.mcap")}
  assert names == {
    "train_1_sweep",
    "train_2_slow",
    "train_3_steps",
    "held_1_multisine",
    "held_2_sweep",
    "reference_1_sweep",
    "reference_2_slow",
    "reference_3_steps",
  }
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "a" / "model.xml"))
  for path in (tmp_path / "a").glob("*.mcap"):
    log = logs.read_log(path)
    compatibility.check_against_model(log, model)
    assert log.duration == pytest.approx(16.0, abs=0.1)
    steps = np.unique(np.round(log.states.position * plant.COUNTS_PER_RADIAN, 6) % 1)
    np.testing.assert_array_equal(steps, [0.0])  # whole encoder counts


def test_every_second_set_of_the_mix_of_halves_is_healthy():
  drawn = [make_blind_sets.mix_of("half", index) for index in range(120)]
  assert drawn[::2] == ["healthy"] * 60
  counts = {mix: drawn.count(mix) for mix in sets.MIXES}
  assert counts == {"healthy": 60, "single": 36, "pair": 12, "outside": 12}
  assert make_blind_sets.mix_of("all", 3) == "all"


def test_the_command_writes_answers_and_resumes(tmp_path):
  root = pathlib.Path(__file__).resolve().parents[2]
  command = [
    sys.executable,
    str(root / "benchmarks/make_blind_sets.py"),
    "--out",
    str(tmp_path),
    "--seed",
    "3",
    "--mix",
    "healthy",
    "--plants",
    "pendulum",
    "--count",
  ]
  subprocess.run([*command, "1"], check=True, capture_output=True, timeout=120)
  written = (tmp_path / "3_000" / "train_1_sweep.mcap").stat().st_mtime_ns
  subprocess.run([*command, "1"], check=True, capture_output=True, timeout=120)
  assert (tmp_path / "3_000" / "train_1_sweep.mcap").stat().st_mtime_ns == written
  answers = json.loads((tmp_path / "answers.json").read_text())
  assert answers["3_000"]["effects"] == [] and answers["3_000"]["plant"] == "pendulum"
