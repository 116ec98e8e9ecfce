"""A task in the browser: robot and room, its picture, its reward; it can be pushed by hand."""

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from viser import transforms

from nerf2real import suite
from nerf2real.core import browser_view
from nerf2real.scenes.field.render import browser as field_view
from nerf2real.scenes.geometry.mesh import load_glb
from nerf2real.suite import loading
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import CameraSettings
from nerf2real.suite.views.drivers import SCRIPTED, Driver, MakeDriver, move_on
from nerf2real.suite.views.third_person import best_angles, clear_distance, direction
from nerf2real.suite.views.viewer_elements import bars, geom_mesh

_SPRING = 40.0  # N/m between the handle that is dragged and the torso
_MAX_FORCE = 20.0  # N
_PUSH_SECONDS = 0.15  # length of a push by a button
_BACKLOG = 0.25  # s that the clock may fall behind before it is set anew
_PICTURE_SCALE = 6  # of the robot's picture on the page
_SHOW_STEPS, _PICTURE_STEPS = 2, 4  # control steps between showings of the motion, of the page
_HANDLE_HEIGHT = 0.28  # m of the handle above the torso, so that it does not hide the robot
_SETBACK = 0.02  # m by which the field's floor is lowered, so that it does not swallow the feet
_LINE_WIDTH = 0.015  # m of the lines on the floor
_STRAYED = (
  0.8  # m that the robot walks before the cameras turn to it; chosen: it stays in the picture
)
_TIME_LIMIT = 120.0  # s; chosen: several goals before the robot starts anew
_DIRECTIONS = {"forward": (1, 0), "back": (-1, 0), "left": (0, 1), "right": (0, -1)}


class TaskViewer:
  """One environment, shown and controlled through a viser server."""

  def __init__(
    self,
    environment: Any,
    server: viser.ViserServer,
    *,
    field: field_view.FieldView | None = None,
    drivers: Mapping[str, MakeDriver] = SCRIPTED,
  ):
    """Fills the page.

    Args:
      environment: From `suite.load`.
      server: The page's server.
      field: Draws the room as a radiance field; None: only as a mesh.
      drivers: What may act, by name; the first one does.
    """
    self._environment, self.server = environment, server
    self._steps = 0
    self._last_episode = ""
    self._makers = dict(drivers)
    self._drivers: dict[str, Driver] = {}
    self._acting = ""  # the name of the one that acted last
    self._push_until, self._push = 0.0, np.zeros(3)
    self._dragging = False
    self._reset_asked = False
    self._faced = np.full(3, np.inf)  # where the page's cameras were turned to last
    self._timestep = environment.reset()
    self._geoms = self._add_geoms()
    self._add_controls()
    self._add_room(field)
    self._show()

  def _add_room(self, field: field_view.FieldView | None) -> None:
    server, task = self.server, self._environment.task
    server.scene.set_up_direction("+z")
    meshes = self._add_meshes(visible=field is None)
    if field is not None:
      switch = field_view.serve_field(server, field, setback=_SETBACK)

      @switch.on_update
      def _(event: Any) -> None:
        for mesh in meshes:
          mesh.visible = not switch.value

    self._goals = [
      server.scene.add_icosphere(
        f"/goals/{index}", radius=0.05, color=(0, 158, 115), position=(*goal, 0.05)
      )
      for index, goal in enumerate(getattr(task, "goals", ()))
    ]
    workspace = getattr(task, "workspace", None)
    if workspace is not None:
      self._add_square("/workspace", workspace.lower, workspace.upper, (120, 126, 135))
      self._add_square("/target", workspace.target - 0.5, workspace.target + 0.5, (0, 158, 115))

    self._face(server.initial_camera)

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
      self._face(client.camera)

  def _face(self, camera: Any) -> None:
    """Puts a camera of the page where nothing stands between it and the robot."""
    environment = self._environment
    position, physics = environment.task.state.position, environment.physics
    way = direction(best_angles(environment.task, physics))
    distance = clear_distance(physics, position, way)
    camera.position = tuple(position + distance * way)
    camera.look_at = tuple(position)

  def _add_meshes(self, *, visible: bool) -> list[Any]:
    """Adds the room's surface, or else its convex parts, and a grid on the floor."""
    server, scene = self.server, self._environment.task.scene
    found: list[Any] = [server.scene.add_grid("/floor", width=8.0, height=8.0, cell_size=0.5)]
    visual = getattr(scene, "visual_path", None)
    if visual is not None and Path(visual).is_file():
      found.append(server.scene.add_mesh_trimesh("/room", load_glb(Path(visual))))
    else:
      for index, path in enumerate(scene.collision_parts):
        part = trimesh.load_mesh(path)
        found.append(
          server.scene.add_mesh_simple(
            f"/room/{index:03d}",
            part.vertices,
            part.faces,
            color=(150, 165, 180),
            opacity=0.6,
            flat_shading=True,
          )
        )
    for mesh in found:
      mesh.visible = visible
    return found

  def _add_square(
    self, name: str, lower: np.ndarray, upper: np.ndarray, color: tuple[int, int, int]
  ) -> None:
    """Draws the sides of a square on the floor, as thin boxes."""
    middle, size = (lower + upper) / 2, upper - lower
    for axis in range(2):
      length = np.full(2, _LINE_WIDTH)
      length[axis] += size[axis]
      for sign in (-1, 1):
        place = middle.copy()
        place[1 - axis] += sign * size[1 - axis] / 2
        self.server.scene.add_box(
          f"{name}/{axis}{sign}", color=color, dimensions=(*length, 0.004), position=(*place, 0.01)
        )

  def _add_geoms(self) -> dict[int, Any]:
    model = self._environment.physics.model.ptr
    handles = {}
    self._radii: dict[int, float] = {}
    for geom in np.flatnonzero(np.isin(model.geom_group, (op3.VISIBLE_GROUP, op3.HEAD_GROUP))):
      mesh = geom_mesh(model, int(geom))
      if mesh is not None:
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
          self._radii[int(geom)] = float(model.geom_size[geom, 0])
        color = tuple(round(255 * c) for c in model.geom_rgba[geom, :3])
        handles[int(geom)] = self.server.scene.add_mesh_simple(
          f"/moving/{geom}", mesh.vertices, mesh.faces, color=color, flat_shading=True
        )
    return handles

  def _add_controls(self) -> None:
    gui = self.server.gui
    self._running = gui.add_checkbox("run", True)
    self._policy = gui.add_dropdown("policy", tuple(self._makers))
    self._follow = gui.add_checkbox("keep the robot in view", True)
    gui.add_button("reset").on_click(lambda _: setattr(self, "_reset_asked", True))
    camera = self._environment.task.robot_camera
    self._picture = None
    if camera is not None:
      blank = np.zeros(camera.shape, np.uint8).repeat(_PICTURE_SCALE, 0).repeat(_PICTURE_SCALE, 1)
      self._picture = gui.add_image(blank, label="robot's camera")
    self._status = gui.add_markdown("")
    self._bars = gui.add_html("")
    if len(getattr(self._environment.task, "goals", ())):
      gui.add_markdown("Green ball: the goal. Grey balls: the other goals.")
    with gui.add_folder("push"):
      gui.add_markdown("Drag the arrows over the robot, or:")
      self._force = gui.add_slider("force [N]", 1.0, _MAX_FORCE, 0.5, 8.0)
      gui.add_button_group("direction", tuple(_DIRECTIONS)).on_click(
        lambda event: self._start_push(event.target.value)
      )
    self._handle = self.server.scene.add_transform_controls(
      "/hand",
      scale=0.16,
      disable_rotations=True,
      disable_sliders=True,
      position=self._handle_place(),
    )

    @self._handle.on_update
    def _(event: Any) -> None:
      self._dragging = event.phase != "end"

  def _handle_place(self) -> np.ndarray:
    """Returns where the handle rests [3] [m]."""
    return self._environment.task.state.position + np.array([0.0, 0.0, _HANDLE_HEIGHT])

  def _start_push(self, direction: str) -> None:
    aligned = self._environment.task.state.aligned
    self._push = aligned @ np.array([*_DIRECTIONS[direction], 0.0]) * self._force.value
    self._push_until = self._environment.physics.time() + _PUSH_SECONDS

  def _hand_force(self) -> np.ndarray:
    """Returns the force of the hand on the torso [3] [N]."""
    force = np.zeros(3)
    if self._dragging:
      force = _SPRING * (np.array(self._handle.position) - self._handle_place())
      force *= min(1.0, _MAX_FORCE / max(float(np.linalg.norm(force)), 1e-9))
    if self._environment.physics.time() < self._push_until:
      force = force + self._push
    return force

  def step(self) -> None:
    """Takes one control step and shows it."""
    environment = self._environment
    if self._reset_asked:
      self._reset_asked = False
      self._timestep = environment.reset()
      self._start_episode()
    task = environment.task
    task.hand_force = self._hand_force()
    timestep = self._timestep = environment.step(self._driver().act(self._timestep.observation))
    move_on(task)
    if timestep.last():
      outcome = task.outcome
      self._last_episode = (
        f"last episode: {'success' if outcome.success else 'no success'}, "
        f"{outcome.ending or 'time limit'} after {outcome.duration:.2f} s"
      )
    if timestep.first():
      self._start_episode()
    self._steps += 1
    self._keep_in_view(within=_STRAYED)
    if self._steps % _SHOW_STEPS == 0:
      self._show(timestep.observation.get("camera"))

  def _driver(self) -> Driver:
    """Returns what acts; one that was chosen anew, or in a new episode, begins here."""
    name = self._policy.value
    if name not in self._drivers:
      self._drivers[name] = self._makers[name](self._environment.task)
    if name != self._acting or self._timestep.first():
      self._acting = name
      self._drivers[name].restart()
    return self._drivers[name]

  def _start_episode(self) -> None:
    """Clears a push and shows the robot where it stands now."""
    self._push_until = 0.0
    self._keep_in_view(within=0.0)

  def _keep_in_view(self, *, within: float) -> None:
    """Turns the cameras to a robot farther than `within` [m] from where they were turned to."""
    position = self._environment.task.state.position
    if self._follow.value and np.linalg.norm(position[:2] - self._faced[:2]) >= within:
      for client in self.server.get_clients().values():
        self._face(client.camera)
      self._faced = position.copy()

  def _show(self, picture: np.ndarray | None = None) -> None:
    environment = self._environment
    model, data, task = (
      environment.physics.model.ptr,
      environment.physics.data.ptr,
      environment.task,
    )
    with self.server.atomic():
      for geom, handle in self._geoms.items():
        handle.position = data.geom_xpos[geom]
        handle.wxyz = transforms.SO3.from_matrix(data.geom_xmat[geom].reshape(3, 3)).wxyz
        if geom in self._radii:  # an episode draws the ball's radius anew
          handle.scale = float(model.geom_size[geom, 0]) / self._radii[geom]
      if not self._dragging:
        self._handle.position = self._handle_place()
      for goal, handle in zip(getattr(task, "goals", ()), self._goals, strict=True):
        handle.color = (0, 158, 115) if np.array_equal(goal, task.goal) else (150, 150, 150)
      if self._steps % _PICTURE_STEPS:
        return
      if picture is not None and self._picture is not None:
        self._picture.image = picture.repeat(_PICTURE_SCALE, 0).repeat(_PICTURE_SCALE, 1)
      self._bars.content = bars(task.reward_terms)
      success = "**success**" if task.outcome.success else "no success yet"
      self._status.content = f"{task.outcome.duration:.2f} s, {success}\n\n{self._last_episode}"

  def run(self, stop: threading.Event) -> None:
    """Steps in real time until told to stop."""
    due = time.monotonic()
    while not stop.is_set():
      if self._running.value:
        self.step()
      due = max(due + constants.CONTROL_TIMESTEP, time.monotonic() - _BACKLOG)
      stop.wait(max(0.0, due - time.monotonic()))


def view_task(
  task: str,
  *,
  scene: Path | None = None,
  drivers: Mapping[str, MakeDriver] = SCRIPTED,
  image_size: tuple[int, int] = (30, 40),
  camera: CameraSettings | None = None,
  host: str = "127.0.0.1",
  port: int = 8080,
) -> TaskViewer:
  """Serves a task's page; the returned viewer's `run` steps it.

  Args:
    task: Name of the task.
    scene: Folder of a scene bundle; None is the built-in room.
    drivers: What may act, by name; the first one does.
    image_size: Height and width of the robot's picture [pixel].
    camera: Of the robot; the suite's own if None.
    host: Address to serve on.
    port: Port to serve on.
  """
  bundle = open_scene(scene)
  renderer = loading.load_renderer(bundle)
  environment = suite.load(
    task,
    scene=bundle,
    renderer=renderer,
    image_size=image_size,
    camera=camera,
    time_limit=_TIME_LIMIT,
    randomisation=RandomisationSettings(pushes=False),  # by hand only
  )
  server = browser_view.serve(f"task {task}", host=host, port=port)
  field = field_view.FieldView(renderer, bundle.world_from_unit)
  return TaskViewer(environment, server, field=field, drivers=drivers)
