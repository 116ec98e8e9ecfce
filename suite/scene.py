"""Opens the scene that an environment, simulated or on a robot, is in."""

from pathlib import Path
from typing import Any


def open_scene(scene: Any) -> Any:
  """Returns an opened bundle from a folder, None (the built-in room) or a bundle."""
  if scene is None or isinstance(scene, str | Path):
    from nerf2real.scenes.bundle import Bundle

    return Bundle.load(scene)
  if not hasattr(scene, "collision_parts"):
    raise ValueError(
      f"scene must be the folder of a scene bundle, an opened bundle, or None for the built-in "
      f"room; found {scene!r}."
    )
  return scene
