"""Simulation, virtual robot and robot as plants of an evaluation, and what disturbs them."""

import dataclasses
import itertools

import mujoco
import numpy as np
import pytest

from nerf2real import suite
from nerf2real.evaluation import runner
from nerf2real.evaluation.plants import making, operated, perturbations, rehearsed, robot_plant
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant, put_down
from nerf2real.evaluation.plants.simulated import SimulatedPlant
from nerf2real.evaluation.policies.policy import GaitPolicy
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite import protocols
from nerf2real.suite.pose import Pose
from nerf2real.suite.scene import open_scene
from nerf2real.suite.tasks.workspace import find_workspace

NEAREST = 46  # a trial of navigation that starts 1.3 m from its goal


@pytest.fixture(scope="module")
def scene():
  return open_scene(None)


@pytest.fixture(scope="module")
def simulated(scene):
  plant = SimulatedPlant(scene, EvaluationSettings(), image_size=None)
  yield plant
  plant.close()


def test_trials_start_where_the_simulations_tasks_have_them(scene, simulated):
  xy = protocols.scene_starts(scene)
  for index in (0, 46):
    trial = protocols.navigation()[index]
    simulated.task.set_trial(trial)
    assert simulated.task.start.xy == pytest.approx(xy[trial.position])
  # At least as much room as at the scene's goals: the robot's radius and 15 cm.
  cells = scene.free_space.cell_of(xy)
  assert (scene.free_space.clearance[cells[:, 0], cells[:, 1]] >= 0.33).all()
  ball = suite.load("ball_push", scene=scene, image_size=None, random=0)
  workspace = find_workspace(scene)
  assert workspace.center == pytest.approx(ball.task.workspace.center)
  for trial in (protocols.ball_center()[3], protocols.ball_wall()[-1], protocols.ball_center()[-1]):
    ball.task.set_trial(trial)
    robot, place = workspace.starts(trial, scene.free_space)
    assert robot == pytest.approx(ball.task.start.xy)
    assert place == pytest.approx(ball.task.ball_start)


def test_other_scenes_effects_and_times_are_other_conditions(tmp_path):
  """The same command with another scene or effects runs its own trials in the same folder."""
  assert plants.conditions_of(EvaluationSettings()) == ""
  assert plants.conditions_of(EvaluationSettings(seed=3, trials=2, processes=2)) == ""
  found = set()
  for number in range(2):
    room, effects = tmp_path / f"{number}" / "room", tmp_path / f"{number}.json"
    room.mkdir(parents=True)
    (room / "scene.json").write_text(f"{number}")
    effects.write_text(f"[{number}]")
    found.add(plants.conditions_of(EvaluationSettings(scene=room)))
    found.add(plants.conditions_of(EvaluationSettings(effects=effects)))
  assert len(found) == 4 and all("room" in text or "effects" in text for text in found)
  changed = EvaluationSettings(plant="virtual", time_limit=20, stochastic=True, placing=(0.0, 0.0))
  assert plants.conditions_of(changed) == "at most 20 s, drawn actions, placed within 0 m, 0 rad"
  seeded = EvaluationSettings(plant="virtual", stochastic=True, seed=2)
  assert plants.conditions_of(seeded) == "drawn actions of seed 2"
  # The paper's tables are of one condition each: parts of another plant must not be among them.
  swapped = EvaluationSettings(plant="virtual", swap=("physics", "lens"))
  assert plants.conditions_of(swapped) == "swapped lens and physics"


def test_repetitions_are_put_down_beside_their_pose():
  """The first stands on its mark, the second within the errors, on every robot the same."""
  pose, errors = Pose(1.0, -2.0, 0.5), (0.03, 0.05)
  first, second = (trial for _, trial in plants.trials("navigation")[6:8])
  assert first[:3] == second[:3]
  assert put_down(pose, first, errors) == pose == put_down(pose, second, (0.0, 0.0))
  moved = put_down(pose, second, errors)
  assert moved == put_down(pose, second, errors)
  others = [put_down(pose, trial, errors) for _, trial in plants.trials("navigation")[1::2]]
  offsets = np.array(others) - pose
  assert len(np.unique(offsets, axis=0)) == 27
  assert (np.abs(offsets) <= (0.03, 0.03, 0.05)).all()
  assert (np.abs(offsets).max(axis=0) > (0.02, 0.02, 0.035)).all()
  ball = plants.trials("ball")[-1][1]
  assert ball.trial == 1 and put_down(pose, ball, errors) == pose


def test_the_gait_reaches_a_goal_in_simulation(scene, simulated):
  group, trial = plants.trials("navigation")[NEAREST]
  policy = GaitPolicy(scene, "navigation")
  found = runner.run_trial(simulated, policy, trial, group=group, index=NEAREST)
  assert found.outcome == "success" and 3 < found.time < 30
  assert found.goal == pytest.approx(scene.goals[2]) and found.setting.plant == "sim"
  start = protocols.scene_starts(scene)[trial.position]
  assert found.path[0][1:3] == pytest.approx(start, abs=0.02)
  distance = np.linalg.norm(np.array(found.path[-1][1:3]) - scene.goals[2])
  assert distance < 0.35  # a point every 0.2 s
  again = runner.run_trial(simulated, policy, trial, group=group, index=NEAREST)
  assert again == found  # the same trial is the same episode


@pytest.mark.parametrize("trained_on, pictures", [("", 8), ("suite:nerf_nav?camera_rate=10", 2)])
def test_the_simulated_camera_has_the_rate_of_the_policys_training(scene, trained_on, pictures):
  settings = EvaluationSettings(policy="a/folder", plant="sim")
  plant = making.make_plant(settings, scene, (6, 8), trained_on=trained_on)
  try:
    plant.start(protocols.navigation()[0])
    seen = [plant.step(np.zeros(20)).observation["camera"].copy() for _ in range(9)]
  finally:
    plant.close()
  assert sum((a != b).any() for a, b in itertools.pairwise(seen)) == pictures


def test_the_gait_reaches_a_goal_on_the_virtual_robot(scene):
  group, trial = plants.trials("navigation")[NEAREST]
  plant = RehearsedPlant(scene, EvaluationSettings(robot_seed=(2,)), image_size=None, world="floor")
  try:
    policy = GaitPolicy(scene, "navigation")
    found = runner.run_trial(plant, policy, trial, group=group, index=NEAREST)
  finally:
    plant.close()
  assert found.outcome == "success" and found.setting.plant_id == "robot 2"
  start = protocols.scene_starts(scene)[trial.position]
  assert found.path[0][1:3] == pytest.approx(start, abs=0.06)


def test_a_virtual_robot_is_altered_and_does_not_say_how(scene):
  altered = undeclared.parse_all(["command_delay:0.045", "supply_course:2,12.5,100"])
  plant = RehearsedPlant(
    scene, EvaluationSettings(), image_size=None, altered=altered, session=50.0, world="floor"
  )
  try:
    motors = plant.robot.body.motors
    assert motors.parameters.goal_delay > 0.045
    motors.torque(0.0, 0.001)
    assert motors.supply == pytest.approx(11.5, abs=0.3)  # half of the course is over
    assert plant.plant_id == "robot 1, altered"
  finally:
    plant.close()


def _standing_in(intruder, time):
  spec = mujoco.MjSpec()
  intruder.add_to_spec(spec)
  model = spec.compile()
  intruder.bind(model)
  data = mujoco.MjData(model)
  intruder.move(data, time)
  mujoco.mj_kinematics(model, data)
  return data.geom_xpos[:, :2].mean(axis=0)


@pytest.mark.parametrize("name", ["moved_object", "person"])
def test_intruders_stand_in_free_space_away_from_starts_and_goals(scene, name):
  clear = plants.keep_clear(scene, protocols.scene_starts(scene))
  intruder = perturbations.make_intruder(name, scene, keep_clear=clear)
  places = np.array([_standing_in(intruder, time) for time in (0.0, 2.0, 5.0)])
  assert scene.free_space.is_reachable(places).all()
  moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
  if name == "person":  # 0.4 m/s, unless it turned round
    assert 0.05 < moved[0] <= 0.81 and 0.05 < moved[1] <= 1.21
  else:
    assert moved.max() == 0
    assert np.linalg.norm(clear - places[0], axis=1).min() > 0.5


def test_person_walks_back_and_forth():
  path = np.array([[0.0, 0.0], [1.0, 0.0]])
  person = perturbations.Intruder((), path, speed=0.5)
  assert person.place(1.0)[0] == pytest.approx([0.5, 0]) and person.place(1.0)[1] == 0
  assert person.place(3.0)[0] == pytest.approx([0.5, 0])
  assert abs(person.place(3.0)[1]) == pytest.approx(np.pi)
  assert person.place(4.2)[0] == pytest.approx([0.1, 0])


def test_walking_into_a_moved_object_is_a_collision(scene):
  plant = SimulatedPlant(scene, EvaluationSettings(perturb="moved_object"), image_size=None)
  try:
    plant.start(plants.trials("navigation")[NEAREST][1])
    pose = plant.sight().pose
    ahead = pose.xy + 0.09 * np.array([np.cos(pose.yaw), np.sin(pose.yaw)])
    plant._intruder._path = (ahead + 0.14)[None]  # a leg of the stool stands in front of the chest
    for _ in range(20):
      plant.step(plant.task.standing_action)
    assert plant.sight().collided
  finally:
    plant.close()


def test_covered_camera_is_black_for_three_seconds(scene):
  assert [perturbations.is_blocked("blocked_camera", t) for t in (2.9, 3.0, 5.9, 6.0)] == [
    False,
    True,
    True,
    False,
  ]
  assert not perturbations.is_blocked("person", 4.0)
  with pytest.raises(ValueError, match="Unknown perturbation 'rain'"):
    perturbations.make_intruder("rain", scene, keep_clear=np.zeros((0, 2)))


def _nearest_trial(plant, scene):
  """Returns what comes of one trial on a plant, which is closed then."""
  group, trial = plants.trials("navigation")[NEAREST]
  try:
    return runner.run_trial(
      plant, GaitPolicy(scene, "navigation"), trial, group=group, index=NEAREST
    )
  finally:
    plant.close()


def test_robot_prompts_for_placement_and_verdict(scene):
  """The robot is a virtual one here; the plant only sees its port and asks a person."""
  alignment = {**scene.scene["alignment"], "marker": {"x": 0.45, "y": -0.08, "heading_deg": 20.1}}
  scene = dataclasses.replace(scene, scene={**scene.scene, "alignment": alignment})
  asked, said = [], []
  answers = iter(["", "x", "l"])

  def ask(question):
    asked.append(question)
    return next(answers)

  with VirtualRobot(world="floor", seed=1, stepped=True) as robot:
    plant = operated.OperatedPlant(
      scene,
      EvaluationSettings(perturb="person", robot=robot.connection(), camera=None, time_limit=0.5),
      image_size=None,
      ask=ask,
      say=said.append,
    )
    found = _nearest_trial(plant, scene)
  _, trial = plants.trials("navigation")[NEAREST]
  start = protocols.scene_starts(scene)[trial.position]
  assert f"x = {start[0]:.2f} m" in asked[0]
  assert "marker lies at x = 0.45 m, y = -0.08 m, its upper edge heading 20" in said[0]
  assert "Goal 3" in said[1] and "Walk slowly around" in said[2] and "Expected one of" in said[3]
  assert len(asked) == 3 and found.outcome == "lost" and found.setting.plant == "robot"


def test_a_dry_run_moves_nothing_and_asks_for_no_verdict(scene):
  asked = []
  with VirtualRobot(world="floor", seed=1, stepped=True) as robot:
    servos = robot.devices.servos.values()
    before = [servo.table["goal_position"] for servo in servos]
    plant = operated.OperatedPlant(
      scene,
      EvaluationSettings(robot=robot.connection(), camera=None, time_limit=0.5, dry_run=True),
      image_size=None,
      ask=lambda question: asked.append(question) or "",
      say=lambda text: None,
    )
    found = _nearest_trial(plant, scene)
    assert not any(servo.table["torque_enable"] for servo in servos)
    assert [servo.table["goal_position"] for servo in servos] == before
  assert len(asked) == 1 and "Place the robot" in asked[0]
  assert found.outcome == "stopped" and found.detail.startswith("dry run; ")
  assert "observation to goal" in found.detail  # what it would have taken


def test_a_robot_that_is_not_there_leaves_terminal_and_folder_as_they_were(
  scene, monkeypatch, tmp_path
):
  """The terminal was put into another mode for the stop key, and the recording was open."""
  given_back = []

  class Terminal:
    ask = None

    def close(self):
      given_back.append(self)

  monkeypatch.setattr(operated, "Terminal", Terminal)
  settings = EvaluationSettings(plant="robot", robot=str(tmp_path / "none"))
  with pytest.raises(OSError, match="cannot be opened"):
    operated.OperatedPlant(scene, settings, image_size=None, record=tmp_path / "log.mcap")
  assert len(given_back) == 1 and list(tmp_path.iterdir()) == []


class _Recorder:
  """Keeps how its recording ended."""

  def __init__(self, path):
    self.ended = []

  def abandon(self):
    self.ended.append("abandoned")

  def close(self):
    self.ended.append("closed")

  def __getattr__(self, name):
    return lambda *args, **kwargs: None


@pytest.fixture
def recorders(monkeypatch):
  """Recorders that were opened, in place of processes."""
  opened = []

  def make(path):
    opened.append(_Recorder(path))
    return opened[-1]

  monkeypatch.setattr(robot_plant, "Recorder", make)
  return opened


def _fail(*_, **__):
  raise RuntimeError("the cable was pulled")


@pytest.mark.parametrize(
  ("module", "name"),
  [
    (rehearsed, "make_intruder"),
    (rehearsed, "VirtualRobot"),
    (rehearsed.real, "load"),
    (operated, "Connection"),
    (operated, "Terminal"),
  ],
)
def test_what_fails_at_the_start_leaves_no_recording_open(
  scene, monkeypatch, tmp_path, recorders, module, name
):
  monkeypatch.setattr(module, name, _fail)
  make = operated.OperatedPlant if module is operated else RehearsedPlant
  with pytest.raises(RuntimeError, match="cable was pulled"):
    make(scene, EvaluationSettings(), image_size=None, record=tmp_path / "log.mcap")
  assert [recorder.ended for recorder in recorders] == [["abandoned"]]


def test_robot_and_recording_are_closed_where_the_environment_fails_to(
  scene, monkeypatch, tmp_path, recorders
):
  virtual = RehearsedPlant(
    scene, EvaluationSettings(), image_size=None, record=tmp_path / "virtual.mcap"
  )
  robot = VirtualRobot(world="floor", seed=1, stepped=True)
  operator = operated.OperatedPlant(
    scene,
    EvaluationSettings(robot=robot.connection(), camera=None),
    image_size=None,
    record=tmp_path / "robot.mcap",
    ask=lambda question: "",
    say=lambda text: None,
  )
  closed = []
  monkeypatch.setattr(virtual.robot, "close", lambda: closed.append("robot"))
  for plant in (virtual, operator):
    close = plant.environment.close
    monkeypatch.setattr(plant.environment, "close", lambda close=close: (close(), _fail()))
    with pytest.raises(RuntimeError, match="cable was pulled"):
      plant.close()
  robot.close()
  assert closed == ["robot"]
  assert [recorder.ended for recorder in recorders] == [["closed"], ["closed"]]
