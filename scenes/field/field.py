"""The radiance field: what it is made of, its evaluation in JAX (the reference), its file.

Shapes: L levels, T entries a level, F features an entry, W width, B bottleneck, V view width.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from nerf2real.core import files
from nerf2real.core.serialization import from_plain, to_plain
from nerf2real.scenes.field import encoding
from nerf2real.scenes.field.contraction import grid_coordinates

FORMAT_VERSION = 1
_METADATA = ("format_version", "settings", "training_pixel_angle")
_LAYER_NORM_EPSILON = 1e-5
Params = Mapping[str, jax.Array | np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldSettings:
  """The field's shape. It is stored with the parameters."""

  levels: int = 8
  """Levels of the hash grid, L. Chosen: what two CPU cores train in
  five minutes; the paper's table: 12."""
  log2_table_size: int = 18
  """Binary logarithm of the entries a level, T. Chosen for two CPU cores, as
  `levels`; the paper's table: 20."""
  features: int = 2
  """Features an entry, F. Mueller et al. 2022, table 1."""
  base_resolution: int = 16
  """Cells along an axis of the coarsest level. Mueller et al. 2022, table 1."""
  growth: float = 1.8114473285278132
  """Ratio of neighbouring levels' resolutions; 16 to 1024 in 8 levels: 1 cm in a room of 5 m."""
  width: int = 64
  """Width of the base network, W. Paper, NeRF table."""
  bottleneck: int = 12
  """Numbers that the base network hands to the view network, B. Chosen: with density and colour,
  1 + 3 + 12 outputs fill one vector of 16."""
  view_width: int = 32
  """Width of the view network, V. Paper, NeRF table."""
  table_init: float = 1e-2
  """The table's first values are uniform within this. Chosen: large against the layer norm's
  constant, which would hide the first steps; Mueller et al. 2022: 1e-4."""
  density_bias: float = -5.0
  """Added before squareplus. Paper, NeRF table."""
  density_gain: float = 40.0
  """Factor on the network's output before the bias; 1 is the paper's. Chosen: squareplus falls off
  as 1/x only, so free space stays a fog for thousands of steps with 1 (after 60 s of
  training at half size: 22.1 dB with 1, 23.1 with 10, 24.6 with 40; with 120 training fails)."""
  density_scale: float = 1.0
  """Density [1/unit] per unit of squareplus. Chosen: with 10 its tail leaves fog."""
  specular_bias: float = -3.0
  """Added before the specular colour's sigmoid. Chosen: sigmoid(-3) = 0.05, so that
  colour starts diffuse."""
  march_step: float = 0.008
  """Interval [unit] between samples inside the unit cube that the field was trained with."""

  def __post_init__(self):
    if self.levels < 1 or self.features < 1 or not 4 <= self.log2_table_size <= 24:
      raise ValueError(
        f"Found levels={self.levels}, features={self.features}, "
        f"log2_table_size={self.log2_table_size}; expected at least one level and feature and a "
        "table of 2^4 to 2^24 entries."
      )

  @property
  def resolutions(self) -> tuple[int, ...]:
    """Cells along an axis, one number a level."""
    return encoding.grid_resolutions(self.base_resolution, self.growth, self.levels)

  @property
  def shapes(self) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters by name; matrices are [inputs, outputs]."""
    inputs = self.levels * self.features + 3
    outputs = 4 + self.bottleneck
    return {
      "table": (self.levels, 2**self.log2_table_size, self.features),
      "base_w1": (inputs, self.width),
      "base_b1": (self.width,),
      "base_w2": (self.width, outputs),
      "base_b2": (outputs,),
      "view_w1": (self.bottleneck + encoding.HARMONICS, self.view_width),
      "view_b1": (self.view_width,),
      "view_w2": (self.view_width, 3),
      "view_b2": (3,),
    }


def squareplus(x: jax.Array) -> jax.Array:
  """Smooth ramp (x + sqrt(x^2 + 4)) / 2. Source: Barron 2021, Squareplus, with b = 4."""
  return 0.5 * (x + jnp.sqrt(x * x + 4.0))


def layer_norm(x: jax.Array) -> jax.Array:
  """Normalises the last axis to mean 0 and variance 1; the next layer absorbs gain and offset."""
  centred = x - jnp.mean(x, axis=-1, keepdims=True)
  variance = jnp.mean(centred * centred, axis=-1, keepdims=True)
  return centred * jax.lax.rsqrt(variance + _LAYER_NORM_EPSILON)


@functools.partial(jax.jit, static_argnames="settings")  # one program, half as long to compile
def init_params(key: jax.Array, settings: FieldSettings) -> dict[str, jax.Array]:
  """Draws parameters: table uniform in +-`table_init`, matrices Glorot uniform."""
  params: dict[str, jax.Array] = {}
  for name, shape in settings.shapes.items():
    key, draw = jax.random.split(key)
    if name == "table":
      params[name] = jax.random.uniform(
        draw, shape, minval=-settings.table_init, maxval=settings.table_init
      )
    elif len(shape) == 2:
      limit = float(np.sqrt(6.0 / sum(shape)))
      params[name] = jax.random.uniform(draw, shape, minval=-limit, maxval=limit)
    else:
      params[name] = jnp.zeros(shape)
  # The variance gives away the camera's distance and direction; a field that starts from those
  # explains every picture by a fog of its own (measured: 16 instead of 25 dB on held-out views).
  params["base_w1"] = params["base_w1"].at[-3:].set(0.0)
  return params


def _base(
  settings: FieldSettings, params: Params, positions: jax.Array, variances: jax.Array
) -> tuple[jax.Array, jax.Array]:
  """Evaluates the base network: density [...] and its other outputs [..., 3 + B]."""
  features = encoding.hash_encode(
    jnp.asarray(params["table"]), grid_coordinates(positions), resolutions=settings.resolutions
  )
  inputs = jnp.concatenate([features, encoding.variance_features(variances)], axis=-1)
  hidden = layer_norm(jax.nn.swish(inputs @ params["base_w1"] + params["base_b1"]))
  outputs = hidden @ params["base_w2"] + params["base_b2"]
  density = settings.density_scale * squareplus(
    settings.density_gain * outputs[..., 0] + settings.density_bias
  )
  return density, outputs[..., 1:]


def query(
  settings: FieldSettings,
  params: Params,
  positions: jax.Array,
  variances: jax.Array,
  directions: jax.Array,
) -> tuple[jax.Array, jax.Array]:
  """Evaluates the field.

  Args:
    settings: The field's shape.
    params: Parameters by name, see `FieldSettings.shapes`.
    positions: Points in the unit frame [..., 3].
    variances: Diagonal variances of the samples [..., 3] [unit^2].
    directions: Unit viewing directions [..., 3].

  Returns:
    density [...] [1/unit] and colour [..., 3]: sigmoid(diffuse) + sigmoid(specular + bias), not
    clipped.

  Source: NeRF2Real, section NeRF training and NeRF table.
  """
  density, outputs = _base(settings, params, positions, variances)
  view = jnp.concatenate([outputs[..., 3:], encoding.spherical_harmonics(directions)], axis=-1)
  hidden = jax.nn.swish(view @ params["view_w1"] + params["view_b1"])
  specular = hidden @ params["view_w2"] + params["view_b2"] + settings.specular_bias
  return density, jax.nn.sigmoid(outputs[..., :3]) + jax.nn.sigmoid(specular)


@dataclasses.dataclass(frozen=True)
class Field:
  """A trained field: its shape, its parameters and the pixel that it was trained with."""

  settings: FieldSettings
  params: dict[str, Any]
  training_pixel_angle: float
  """Angle that a pixel of the training pictures spans [rad]."""

  def save(self, path: str | Path) -> None:
    """Writes a safetensors file; the table and nothing else is rounded to float16."""
    tensors = {}
    for name, value in self.params.items():
      kind = np.float16 if name.endswith("table") else np.float32
      tensors[name] = np.ascontiguousarray(np.asarray(value), kind)
    metadata = {
      "format": "radiance field",
      "format_version": str(FORMAT_VERSION),
      "settings": json.dumps(to_plain(self.settings)),
      "training_pixel_angle": repr(float(self.training_pixel_angle)),
    }
    files.write_atomically(path, safetensors.numpy.save(tensors, metadata=metadata))

  @classmethod
  def load(cls, path: str | Path) -> "Field":
    """Reads what `save` wrote; parameters become float32.

    Raises:
      ValueError: The file is cut off, damaged or no field of this version; the message is one line.
    """
    try:
      with safetensors.safe_open(path, "numpy") as file:
        metadata = file.metadata() or {}
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
      raise ValueError(
        f"{path} is damaged: found {Path(path).stat().st_size:,} bytes that are no whole "
        f"safetensors file ({error}), expected a radiance field. Copy it again from where it came, "
        "or make the bundle again."
      ) from error
    if metadata.get("format") != "radiance field":
      raise ValueError(
        f"{path} holds no radiance field (metadata {metadata}); expected a file that Field.save "
        "wrote."
      )
    lacking = [name for name in _METADATA if name not in metadata]
    if lacking:
      raise ValueError(
        f"{path} is damaged: its metadata lacks {', '.join(lacking)}; make the bundle again."
      )
    if int(metadata["format_version"]) > FORMAT_VERSION:
      raise ValueError(
        f"{path} has format version {metadata['format_version']}, this program reads up to "
        f"{FORMAT_VERSION}; update the program."
      )
    values = json.loads(metadata["settings"])
    rule = values.pop("footprint_rule", "additive")  # written until there was one rule only
    if rule != "additive":
      raise ValueError(
        f"{path} was trained with footprint_rule={rule!r}, which this program no longer renders; "
        "expected 'additive': train the field again."
      )
    settings = from_plain(values, FieldSettings, source=path)
    params = {name: array.astype(np.float32) for name, array in arrays.items()}
    for name, shape in settings.shapes.items():
      if name not in params or params[name].shape != shape:
        found = params[name].shape if name in params else "nothing"
        raise ValueError(f"{path}: parameter {name} should have shape {shape}, found {found}.")
    return cls(settings, params, float(metadata["training_pixel_angle"]))
