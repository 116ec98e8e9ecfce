"""3D Gaussian splats of spherical-harmonics degree 0, and their PLY file.

Shapes: N splats. The file's layout is that of the reference implementation of Kerbl et al. 2023,
3D Gaussian Splatting for Real-Time Radiance Field Rendering: logarithms of the standard deviations,
logits of the opacities, quaternions (w, x, y, z), colours as coefficients of Y_00.
"""

import dataclasses
from pathlib import Path

import numpy as np

from nerf2real.core import files

Y_00 = 0.28209479177387814  # 1 / (2 sqrt(pi))
_FIELDS = (
  *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
  *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


@dataclasses.dataclass(frozen=True)
class Splats:
  """Gaussians in the world frame."""

  positions: np.ndarray  # [N, 3] m
  rotations: np.ndarray  # unit quaternions (w, x, y, z) [N, 4]
  scales: np.ndarray  # standard deviations along the own axes [N, 3] m
  opacities: np.ndarray  # in (0, 1) [N]
  colors: np.ndarray  # display values, 0 to 1 where not clipped [N, 3]

  def __len__(self) -> int:
    return len(self.positions)

  def save_ply(self, path: Path) -> None:
    """Writes a binary PLY file."""
    opacity = np.clip(self.opacities, 1e-6, 1 - 1e-6)
    rows = np.concatenate(
      [
        self.positions,
        np.zeros_like(self.positions),
        (self.colors - 0.5) / Y_00,
        np.log(opacity / (1 - opacity))[:, None],
        np.log(self.scales),
        self.rotations,
      ],
      axis=1,
    )
    header = ["ply", "format binary_little_endian 1.0", "comment metres, z up"]
    header += [f"element vertex {len(rows)}", *(f"property float {name}" for name in _FIELDS)]
    text = "\n".join([*header, "end_header"]) + "\n"
    files.write_atomically(path, text.encode("ascii") + rows.astype("<f4").tobytes())

  @classmethod
  def load_ply(cls, path: Path) -> "Splats":
    """Reads what `save_ply` wrote.

    Raises:
      ValueError: The file is no such PLY.
    """
    head, found, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    names = tuple(line.split()[-1] for line in lines if line.startswith("property float"))
    if not found or names != _FIELDS or "format binary_little_endian 1.0" not in lines:
      raise ValueError(
        f"{path} is no PLY of splats of degree 0 (properties {names[:4]}...): give a file that "
        "launch/export_scene.py --to splat wrote."
      )
    count = next((line.split()[-1] for line in lines if line.startswith("element vertex ")), "")
    size = 4 * len(_FIELDS)  # bytes of a splat
    if not count.isdecimal() or len(body) != int(count) * size:
      raise ValueError(
        f"{path} is cut or damaged: found {len(body) / size:g} splats, expected {count or 'none'}: "
        "copy or export it again."
      )
    rows = np.frombuffer(body, "<f4").reshape(-1, len(_FIELDS)).astype(np.float64)
    rotations = rows[:, 13:17] / np.linalg.norm(rows[:, 13:17], axis=1, keepdims=True)
    return cls(
      positions=rows[:, :3],
      rotations=rotations,
      scales=np.exp(rows[:, 10:13]),
      opacities=1 / (1 + np.exp(-rows[:, 9])),
      colors=rows[:, 6:9] * Y_00 + 0.5,
    )
