"""Exports a scene bundle to another program's format: one function a kind."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from nerf2real.core import files
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.scenes.bundle import STAGES, Bundle
from nerf2real.scenes.export import gltf, heightfield, mjcf, nerfstudio, texture, usd, views
from nerf2real.scenes.geometry import collision
from nerf2real.scenes.geometry import mesh as meshes

Kind = Literal["splat", "mjcf", "usd", "glb", "nerfstudio", "heightfield"]
KINDS: tuple[str, ...] = get_args(Kind)
_TEXTURE_WIDTH = 480  # of the pictures that a texture is baked from [pixel]
_TEXTURE_VIEWS = 60  # pictures that a texture is baked from


class Order(NamedTuple):
  """What to export."""

  bundle: Bundle
  out: Path
  robot: mjcf.StandingRobot | None = None  # added to an MJCF scene
  splat_seconds: float | None = None  # time of the splats' fit at most [s]
  progress: Progress = no_progress


def _textured(order: Order, progress: Progress) -> texture.TexturedMesh:
  """The surface mesh with a texture from pictures of the field."""
  shown = meshes.load_glb(order.bundle.visual_path)
  pictures = views.capture_views(
    order.bundle,
    views.renderer_of(order.bundle),
    width=_TEXTURE_WIDTH,
    count=_TEXTURE_VIEWS,
    progress=part(progress, 0.0, 0.6),
  )
  progress(0.6, "texture")
  return texture.bake(meshes.Mesh(shown.vertices, shown.faces), pictures)


def _mjcf(order: Order) -> str:
  bundle = order.bundle
  parts = collision.read_parts(bundle.folder / "collision")
  spec = mjcf.scene_spec(parts, extent=bundle.extent, name=bundle.name)
  mjcf.add_camera(spec, *views.overlooking_view(bundle), name="capture")
  if order.robot is not None:
    mjcf.add_robot(spec, order.robot, bundle.free_space.roomiest())
  mjcf.write(order.out, spec, parts, _textured(order, order.progress))
  return f"python -m mujoco.viewer --mjcf={order.out / 'scene.xml'}"


def _glb(order: Order) -> str:
  gltf.write(order.out, _textured(order, order.progress))
  return "metres, y up as glTF prescribes; every glTF viewer opens it"


def _usd(order: Order) -> str:
  bundle = order.bundle
  camera, world_from_camera = views.overlooking_view(bundle)
  usd.write(
    order.out,
    visual=meshes.load_glb(bundle.visual_path),
    parts=collision.read_parts(bundle.folder / "collision"),
    extent=bundle.extent,
    camera=camera,
    world_from_camera=world_from_camera,
  )
  return "metres, z up; colliders are guides, which viewers hide at first"


def _heightfield(order: Order) -> str:
  bundle = order.bundle
  parts = collision.read_parts(bundle.folder / "collision")
  height = heightfield.heights(parts, bundle.extent)
  heightfield.write(order.out, height, bundle.extent, name=bundle.name)
  return f"python -m mujoco.viewer --mjcf={order.out / 'scene.xml'}"


def _nerfstudio(order: Order) -> str:
  source = nerfstudio.write(order.out, order.bundle, progress=order.progress)
  return f"pictures: {source}; ns-train splatfacto --data {order.out}"


def _splat(order: Order) -> str:
  from nerf2real.scenes.export.splats import fitting  # JAX: seconds to load

  settings = fitting.FitSettings(seconds=order.splat_seconds)
  splats = fitting.fit(order.bundle, settings=settings, progress=order.progress)
  splats.save_ply(order.out)
  return f"{len(splats)} splats of degree 0; metres, z up"


_EXPORTERS: dict[str, Callable[[Order], str]] = {
  "splat": _splat,
  "mjcf": _mjcf,
  "usd": _usd,
  "glb": _glb,
  "nerfstudio": _nerfstudio,
  "heightfield": _heightfield,
}
_SUFFIXES = {"splat": (".ply",), "glb": (".glb",), "usd": usd.SUFFIXES}  # others are folders
_MARKS = {  # a file that a folder of the kind has, and other programs' folders do not
  "mjcf": "assets/visual.obj",
  "nerfstudio": nerfstudio.POINTS,
  "heightfield": heightfield.PICTURE,
}


def _check_replaced(kind: Kind, order: Order) -> None:
  """Raises ValueError where --out has something else than an earlier export of the kind."""
  out, bundle, mark = order.out.resolve(), order.bundle.folder.resolve(), _MARKS.get(kind)
  if out == bundle or out in bundle.parents:
    raise ValueError(
      f"--out {order.out} is or holds the scene bundle {order.bundle.folder}, which the export "
      "would replace: name a folder or file of its own."
    )
  if Path.cwd().is_relative_to(out):
    raise ValueError(f"--out {order.out} is or holds the folder that you are in: name another one.")
  if STAGES in out.parts or out == order.bundle.visual_path.resolve():
    raise ValueError(
      f"--out {order.out} is a part of a scene bundle, which the export would replace: name "
      "another one."
    )
  if mark is None:
    if out.is_dir():
      raise ValueError(f"--out {order.out} is a folder, expected a file for {kind}: name another.")
  elif out.exists() and not out.is_dir():
    raise ValueError(f"--out {order.out} is a file, expected a folder for {kind}: name another.")
  elif out.is_dir() and not (out / mark).is_file() and any(out.iterdir()):
    raise ValueError(
      f"--out {order.out} holds files and no {mark}: expected a new or empty folder, or an earlier "
      f"{kind} export, which is replaced; name another one."
    )


def export(kind: Kind, order: Order) -> str:
  """Writes a bundle in another format; the file or folder appears whole or not at all.

  Returns:
    A line for the user: what was written and how to open it.

  Raises:
    OSError: The file or folder cannot be written.
    ValueError: The name does not fit the kind, what is there under it is no earlier export of the
      kind, or the bundle lacks what the kind needs.
  """
  suffixes = _SUFFIXES.get(kind, ("",))
  if order.out.suffix not in suffixes:
    expected = " or ".join(suffixes) if suffixes[0] else "no suffix: it becomes a folder"
    raise ValueError(f"Found --out {order.out} for {kind}; expected {expected}.")
  if order.robot is not None and kind != "mjcf":
    raise ValueError(f"A robot can be added to mjcf only, found {kind}: leave --robot out.")
  _check_replaced(kind, order)
  order.out.parent.mkdir(parents=True, exist_ok=True)
  files.check_writable(order.out)
  return _EXPORTERS[kind](order)
