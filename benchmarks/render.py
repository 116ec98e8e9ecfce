"""Times the field's renderer beside MuJoCo's own and a plain JAX render of the same field.

All of them draw the same views of the built-in room, taking turns on one core, and are compared
with the true picture (each pixel the mean over its area). MuJoCo draws the true geometry with the
true textures: what it lacks in PSNR is aliasing, what the field lacks is reconstruction.

  python benchmarks/render.py                       # the scene that is shipped
  python benchmarks/render.py --bundle out/demo     # a bundle of the built-in room
  python benchmarks/render.py --field F --room-from-unit S.json
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported

import dataclasses
import datetime
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rich.console
import rich.table
import tyro

from nerf2real.core import rotations
from nerf2real.core.cameras import Camera
from nerf2real.core.serialization import from_plain, read_json
from nerf2real.core.similarity import Similarity
from nerf2real.scenes import bundle
from nerf2real.scenes.builtin import furniture, room
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render import reference as render_reference
from nerf2real.scenes.field.render import renderer as render
from nerf2real.scenes.quality.image_quality import psnr

SIZES = ((30, 40), (60, 80))  # picture sizes [H, W] of the policies
FIELD_OF_VIEW = np.deg2rad(43.3)  # vertical, Logitech C920
EYE_HEIGHT = 0.44  # of the robot's camera [m]
LOOK_DOWN = 0.3  # [rad]
WALL_DISTANCE = 0.2  # from the border of the free area [m]
PAPER_MS = 6.0  # NeRF2Real, section NeRF training: a frame on a V100

Draw = Callable[[int], np.ndarray]  # number of the view -> uint8 [H, W, 3]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
  """Settings of the benchmark."""

  bundle: Path | None = None
  """A bundle of the built-in room; the shipped one if neither this nor a field is given."""
  field: Path | None = None
  """A field file instead of a bundle."""
  room_from_unit: Path | None = None
  """With a field: the similarity (JSON) that maps its frame to the room's; the bundle knows its."""
  views: int = 40
  """Views that are drawn."""
  jax_views: int = 3
  """Views that the slow JAX render draws."""
  repeats: int = 3
  """Times that each view is drawn."""
  core: int = 0
  """The processor core that everything runs on."""
  out: Path = Path(__file__).parent / "results"
  """Folder of the results (Markdown and JSON)."""


def load_field(settings: Settings) -> tuple[Field, Similarity]:
  """Returns the field and the similarity from its frame to the room's."""
  if settings.field is not None:
    if settings.room_from_unit is None:
      raise SystemExit("--field needs --room-from-unit: where the field lies in the room.")
    return Field.load(settings.field), read_json(settings.room_from_unit, Similarity)
  scene = bundle.Bundle.load(settings.bundle)
  placed = scene.figures.get("room_from_world")
  if placed is None:
    raise SystemExit(
      f"{scene.folder} has no figure room_from_world: it is no bundle of the built-in room, whose "
      "true pictures this benchmark compares with."
    )
  return Field.load(scene.field_path), from_plain(placed, Similarity) @ scene.world_from_unit


def robot_poses(count: int, *, seed: int = 7) -> np.ndarray:
  """Draws poses [N, 4, 4] of the robot's camera in the room."""
  random = np.random.default_rng(seed)
  lower, upper = (np.array(corner) for corner in furniture.FREE_AREA)
  poses = np.tile(np.eye(4), (count, 1, 1))
  for pose in poses:
    yaw, tilt = random.uniform(0, 2 * np.pi), LOOK_DOWN + random.normal(0, 0.05)
    forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
    pose[:3, :3] = rotations.camera_axes(forward)
    pose[:2, 3] = random.uniform(lower + WALL_DISTANCE, upper - WALL_DISTANCE)
    pose[2, 3] = EYE_HEIGHT
  return poses


class MujocoDrawer:
  """MuJoCo's renderer with a camera that can be put anywhere."""

  def __init__(self, camera: Camera, poses: np.ndarray, *, fast: bool):
    """Compiles the room; fast: without shadows, reflections and multisampling."""
    spec = room.build_room()
    quality, standard = spec.visual.quality, mujoco.MjSpec().visual.quality
    quality.shadowsize = 0 if fast else standard.shadowsize
    quality.offsamples = 0 if fast else standard.offsamples
    body = spec.worldbody.add_body(name="eye", mocap=True)
    body.add_camera(name="eye", fovy=np.rad2deg(camera.vertical_fov))
    self._model = spec.compile()
    self._data = mujoco.MjData(self._model)
    self._renderer = mujoco.Renderer(self._model, height=camera.height, width=camera.width)
    if fast:
      for flag in ("SHADOW", "REFLECTION", "SKYBOX", "HAZE", "FOG"):
        self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
    self._places = []
    for pose in poses:
      rotation = pose[:3, :3] @ rotations.OPENGL_FROM_OPENCV
      quaternion = rotations.quaternion_from_matrix(rotation)
      self._places.append((pose[:3, 3], quaternion))

  def draw(self, view: int) -> np.ndarray:
    """Renders a view: uint8 [H, W, 3]."""
    self._data.mocap_pos[0], self._data.mocap_quat[0] = self._places[view]
    mujoco.mj_kinematics(self._model, self._data)
    mujoco.mj_camlight(self._model, self._data)
    self._renderer.update_scene(self._data, camera="eye")
    return self._renderer.render()

  def close(self) -> None:
    """Frees the OpenGL context."""
    self._renderer.close()


def measure(draws: dict[str, Draw], limits: dict[str, int], truth: list[np.ndarray], repeats: int):
  """Lets the drawers take turns.

  Times are the process's processor time, all threads, because everything shares one core: on an
  idle core that is the time that passes, on a busy one it leaves out the others' turns.

  Returns:
    One dict a drawer: name, median_ms, p95_ms, elapsed_ms (median), psnr_db, views.
  """
  times: dict[str, list[float]] = {name: [] for name in draws}
  elapsed: dict[str, list[float]] = {name: [] for name in draws}
  quality: dict[str, list[float]] = {name: [] for name in draws}
  for draw in draws.values():
    draw(0)  # compiles, allocates
  for repeat in range(repeats):
    for view, picture in enumerate(truth):
      for name, draw in draws.items():
        if view >= limits.get(name, len(truth)):
          continue
        start, start_elapsed = time.process_time(), time.perf_counter()
        drawn = draw(view)
        times[name].append((time.process_time() - start) * 1e3)
        elapsed[name].append((time.perf_counter() - start_elapsed) * 1e3)
        if repeat == 0:
          quality[name].append(psnr(drawn, picture))
  return [
    {
      "name": name,
      "median_ms": float(np.median(times[name])),
      "p95_ms": float(np.percentile(times[name], 95)),
      "elapsed_ms": float(np.median(elapsed[name])),
      "psnr_db": float(np.mean(quality[name])),
      "views": len(quality[name]),
    }
    for name in draws
  ]


def processor() -> str:
  """Returns the processor's name."""
  try:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
  except (OSError, StopIteration):
    return platform.processor() or platform.machine()


def run(settings: Settings) -> dict[str, Any]:
  """Measures all sizes."""
  field, room_from_unit = load_field(settings)
  unit_from_room = room_from_unit.inverse()
  poses = robot_poses(settings.views)
  unit_poses = unit_from_room.apply_pose(poses)
  render.Renderer(field)  # compiles the kernels where they are not in the cache
  start = time.perf_counter()
  renderer = render.Renderer(field)
  ready = time.perf_counter() - start
  result: dict[str, Any] = {
    "date": datetime.date.today().isoformat(),
    "processor": processor(),
    "system": platform.platform(),
    "renderer_ready_s": ready,
    "render_settings": dataclasses.asdict(renderer.settings),
    "field_settings": dataclasses.asdict(field.settings),
    "sizes": {},
  }
  for height, width in SIZES:
    camera = Camera.from_vertical_fov(FIELD_OF_VIEW, width, height)
    with room.room_eye() as eye:
      truth = [room.true_view(camera, pose, eye=eye)[0] for pose in poses]
    fast, standard = (MujocoDrawer(camera, poses, fast=fast) for fast in (True, False))

    def ours(view: int, camera: Camera = camera) -> np.ndarray:
      return renderer.render(camera, unit_poses[view])[0]

    def plain(view: int, camera: Camera = camera) -> np.ndarray:
      return render_reference.render_picture(
        field, None, camera, unit_poses[view], settings=renderer.settings
      )[0]

    draws: dict[str, Draw] = {
      "field, Warp": ours,
      "field, plain JAX": plain,
      "MuJoCo, fast flags": fast.draw,
      "MuJoCo, default flags": standard.draw,
    }
    limits = {"field, plain JAX": settings.jax_views}
    result["sizes"][f"{height}x{width}"] = measure(draws, limits, truth, settings.repeats)
    fast.close()
    standard.close()
  return result


def markdown(result: dict[str, Any]) -> str:
  """Returns the results as a Markdown page."""
  lines = [
    "# Rendering a robot camera's frame on one core",
    "",
    f"{result['processor']}, {result['date']}. Views of the built-in room from the robot's height; "
    "Median and p95 are processor time, elapsed is by the clock; PSNR against the true picture. "
    "`python benchmarks/render.py` makes this page.",
    "",
    "| size | renderer | median ms | p95 ms | elapsed ms | PSNR dB | views |",
    "|---|---|---|---|---|---|---|",
  ]
  for size, rows in result["sizes"].items():
    for row in rows:
      lines.append(
        f"| {size} | {row['name']} | {row['median_ms']:.2f} | {row['p95_ms']:.2f} | "
        f"{row['elapsed_ms']:.2f} | {row['psnr_db']:.1f} | {row['views']} |"
      )
  lines += [
    "",
    f"For comparison: the paper's renderer takes {PAPER_MS:.0f} ms a frame on a V100. Making the "
    f"renderer ready (kernels from the cache, occupancy) took {result['renderer_ready_s']:.1f} s.",
    "MuJoCo draws the true model with the true textures; the field was reconstructed from video.",
    "",
  ]
  return "\n".join(lines)


def main(settings: Settings) -> None:
  """Runs the benchmark, prints a table and writes the results."""
  if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {settings.core})
  result = run(settings)
  table = rich.table.Table(title=f"One core of {result['processor']}")
  for column in ("size", "renderer", "median ms", "p95 ms", "elapsed ms", "PSNR dB", "views"):
    table.add_column(column)
  for size, rows in result["sizes"].items():
    for row in rows:
      table.add_row(
        size,
        row["name"],
        f"{row['median_ms']:.2f}",
        f"{row['p95_ms']:.2f}",
        f"{row['elapsed_ms']:.2f}",
        f"{row['psnr_db']:.1f}",
        str(row["views"]),
      )
  rich.console.Console().print(table)
  settings.out.mkdir(parents=True, exist_ok=True)
  name = "render_" + "_".join(result["processor"].lower().split())
  (settings.out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
  (settings.out / f"{name}.md").write_text(markdown(result))
  print(f"Written to {settings.out / name}.md and .json")


if __name__ == "__main__":
  main(tyro.cli(Settings, description=__doc__))
