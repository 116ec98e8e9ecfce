"""What the fused kernels read and write: rows of the work arrays, and Warp's structures."""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

from typing import NamedTuple

import warp as wp

from nerf2real.scenes.field import encoding
from nerf2real.scenes.field.field import FieldSettings

CHUNK_RAYS = 128  # of a chunk at most
RAY_ROWS = 18  # of Worker.rays
CHUNK_SAMPLES = 768  # chosen: a thread's activations stay in a second-level cache of 1 MB
Floats = wp.array(dtype=wp.float32)
Ints = wp.array(dtype=wp.int32)
MULTIPLE = 8  # of the widths: a tile of the matrix products, see `native/vectors.py`
# An odd number of cache lines, as rows a power of two apart would share a cache's sets.
STRIDE = CHUNK_SAMPLES + 48


class Rows(NamedTuple):
  """First rows of a chunk's work array, and how many there are."""

  DISTANCE: int
  LENGTH: int
  PLACE_U: int  # grid coordinates [3]
  GAIN: int  # of the layer norm
  ALPHA: int
  WEIGHT: int
  THROUGH: int  # transmittance behind the sample
  D_WEIGHT: int
  INPUT: int  # [2 L + 3], a row of ones for the bias
  HIDDEN: int  # [W], a row of ones
  SLOPE: int  # [W]: of the activation, then the gradient before it
  OUT: int  # [4 + B], spherical harmonics [9], a row of ones
  VIEW_SLOPE: int  # [V]
  VIEW_HIDDEN: int  # [V], a row of ones, zeros up to a multiple of 8
  COLOR: int  # [6]: diffuse, specular
  D_COLOR: int  # [3]
  D_OUT: int  # [4 + B]
  COUNT: int


class Shape(NamedTuple):
  """The field's shape, compiled into the kernels."""

  levels: int
  width: int
  bottleneck: int
  view: int

  @classmethod
  def of(cls, settings: FieldSettings) -> "Shape":
    """Returns the shape of a field.

    Raises:
      ValueError: The kernels cannot run it.
    """
    widths = {
      "levels * features": settings.levels * settings.features,
      "width": settings.width,
      "view_width": settings.view_width,
      "4 + bottleneck": 4 + settings.bottleneck,
    }
    wrong = [f"{name} = {value}" for name, value in widths.items() if value % MULTIPLE]
    if settings.features != 2:
      wrong.append(f"features = {settings.features}")
    if wrong:
      raise ValueError(
        f"The fused kernels need 2 features an entry and multiples of {MULTIPLE}; found "
        f'{", ".join(wrong)}. Change the field\'s settings or use engine="jax".'
      )
    return cls(settings.levels, settings.width, settings.bottleneck, settings.view_width)

  @property
  def inputs(self) -> int:
    return 2 * self.levels + 3

  @property
  def outputs(self) -> int:
    return 4 + self.bottleneck

  @property
  def view_at(self) -> int:
    """Where the view network's parameters start."""
    return (self.inputs + 1) * self.width + (self.width + 1) * self.outputs

  @property
  def parameters(self) -> int:
    """Parameters of both networks."""
    return self.view_at + (self.bottleneck + 10) * self.view + (self.view + 1) * 3

  @property
  def tiles(self) -> int:
    """About how many tiles of 3 x 8 the matrices' gradients have: parts of the work."""
    return self.parameters // 24

  @property
  def rows(self) -> Rows:
    one, levels, heads = 1, self.inputs, self.outputs  # heads: outputs of the base network
    before = [one, one, 3, one, one, one, one, one]  # DISTANCE to D_WEIGHT
    base = [levels + 1, self.width + 1, self.width, heads + encoding.HARMONICS + 1]
    view = [self.view, self.view + MULTIPLE, 6, 3, heads]
    sizes = before + base + view
    starts = [sum(sizes[:i]) for i in range(len(sizes) + 1)]
    return Rows(*starts)

  @property
  def ones(self) -> tuple[int, int, int, int]:
    """Rows that hold 1."""
    rows = self.rows
    harmonics_end = rows.OUT + self.outputs + encoding.HARMONICS
    return (
      rows.INPUT + self.inputs,
      rows.HIDDEN + self.width,
      harmonics_end,
      rows.VIEW_HIDDEN + self.view,
    )


@wp.struct
class Pictures:
  """Training pictures: K levels of blur of N pictures, see views.BlurPyramid."""

  pixels: wp.array(dtype=wp.uint8)  # every level [N, h, w, 3] behind the other
  starts: Ints  # [K]: where a level starts in `pixels`
  heights: Ints  # [K]
  widths: Ints  # [K]
  factors: Floats  # [K]: how much smaller a level's pictures are
  blurs: Floats  # [K]: standard deviation [pixel of the full size]
  directions: wp.array(dtype=wp.vec3)  # [H * W]: camera rays, z = 1
  rotations: wp.array(dtype=wp.mat33)  # [N]: unit frame from camera
  origins: wp.array(dtype=wp.vec3)  # [N]
  anchors: wp.array(dtype=wp.vec4)  # [A]: picture, pixel x and y, distance along the ray [unit]
  empty: Ints  # [E]: cells of the unit cube known to be empty


@wp.struct
class Settings:
  """Numbers that the kernels need, see FieldSettings and TrainSettings."""

  density_gain: wp.float32
  density_bias: wp.float32
  density_scale: wp.float32
  specular_bias: wp.float32
  pixel_angle: wp.float32
  step: wp.float32
  variance_step: wp.float32  # interval of the variance, inside the unit cube
  near: wp.float32
  near_scale: wp.float32  # a sample's gradient is scaled by min(1, this * squared distance)
  depth_limit: wp.float32  # a first march ends where the grid's optical depth passes this
  ray_samples: wp.int32  # most samples of a ray
  charbonnier: wp.float32
  distortion: wp.float32
  blur_max: wp.float32
  blur_sharp: wp.float32  # fraction of the rays that are not blurred
  blur_power: wp.float32  # blur = blur_max * uniform^power
  random_background: wp.int32
  planar_fraction: wp.float32  # fraction of the rays that come in threes along a line
  planar_weight: wp.float32
  planar_bend: wp.float32  # relative bend from where on it is an edge
  planar_contrast: wp.float32  # of colour, from where on a picture tells the surface itself
  planar_reach: wp.int32  # most pixels between two of three
  anchor_fraction: wp.float32  # fraction of the rays that end at a known point
  anchor_weight: wp.float32
  empty_samples: wp.int32  # points a worker in cells known to be empty
  empty_weight: wp.float32
  empty_size: wp.int32  # such cells along an axis of the unit cube


@wp.struct
class Occupancy:
  """Where matter may be: distances to the nearest cell that is occupied, and densities."""

  inner_size: wp.int32  # cells along an axis of the unit cube
  inner_distance: wp.array(dtype=wp.uint8)  # cells, 0 where occupied
  inner_density: Floats  # [1/unit]
  outer_size: wp.int32  # the same for the whole squashed space
  outer_distance: wp.array(dtype=wp.uint8)
  outer_density: Floats


@wp.struct
class Model:
  """The field's parameters."""

  table: Floats  # [L, T, 2]
  levels: Ints  # [4, L], see encoding.level_rows
  entries: wp.int32  # T
  weights: Floats  # both networks', see Shape


@wp.struct
class Worker:
  """Work arrays of a CPU thread, or of a GPU."""

  work: Floats  # [rows, samples], see Rows
  rays: Floats
  """[RAY_ROWS, rays]: origin, direction, target, footprint, background, anchor or 0; of rays in
  threes: place (1 to 3, 0 for others), number of the three, 1 / z of the direction in the camera's
  frame, and 1 / z of where the ray ends."""
  ray_of: Ints  # [samples]
  first: Ints  # [rays + 1]: a ray's first sample
  last: Ints  # [rays]: behind a ray's last visible sample
  number: Ints  # [rays]: a ray's number, see chunks; negative where the limit ended its march
  again: Ints  # [rays]: numbers of the rays that are to be marched again
  gradient: Floats  # of both networks
  kept: Floats  # [3 + 2 L, S]: coordinates and features' gradients of a step
  kept_stride: wp.int32  # S
  figures: wp.array(dtype=wp.float64)
  """[6]: rays, kept samples, marched samples; sums over the rays of squared error, Charbonnier loss
  and distortion loss."""


Workers = wp.array(dtype=Worker)


@wp.struct
class Optimised:
  """Parameters with their gradient and Adam's moments."""

  values: Floats
  gradient: Floats
  first: Floats
  second: Floats


@wp.struct
class AdamW:
  """Numbers of a step of AdamW. Source: Loshchilov and Hutter 2019, algorithm 2."""

  rate: wp.float32
  keep: wp.float32  # 1 - rate * decay
  beta1: wp.float32
  beta2: wp.float32
  epsilon: wp.float32
  correction1: wp.float32  # 1 / (1 - beta1^t)
  correction2: wp.float32
