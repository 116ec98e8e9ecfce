"""The trainer's functions of samples and rays in Warp, for one shape of field.

The arithmetic on samples is C++ (`native/`), a vector at a time. `chunks` and
`phases` build kernels of these functions.
"""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import functools
from typing import Any, NamedTuple

import warp as wp

from nerf2real.scenes.field.engine import losses
from nerf2real.scenes.field.engine.layout import (
  CHUNK_SAMPLES,
  AdamW,
  Floats,
  Model,
  Occupancy,
  Optimised,
  Settings,
  Shape,
  Worker,
)
from nerf2real.scenes.field.engine.native import grid as native_grid
from nerf2real.scenes.field.engine.native import network as native_network
from nerf2real.scenes.field.engine.native.vectors import snippet
from nerf2real.scenes.field.engine.rays import march, uniform


class Functions(NamedTuple):
  """Functions on samples [begin, end) of a worker, and the numbers compiled into them."""

  shape: Shape
  stride: int  # samples in a row of a worker's arrays
  ray_columns: int  # rays in a row of them
  place: Any  # distances -> grid coordinates and extents
  encode: Any  # grid coordinates -> features
  base_forward: Any
  opacity: Any
  keep_visible: Any  # drops what lies behind matter
  view_forward: Any
  view_backward: Any
  base_backward: Any
  network_gradient: Any
  scatter_points: Any  # the table's gradient
  adam_range: Any
  march_ray: Any
  losses: losses.Losses


@functools.cache
def build(shape: Shape, stride: int, ray_columns: int) -> Functions:
  """Defines the functions.

  Args:
    shape: The field's shape.
    stride: Samples in a row of a worker's arrays.
    ray_columns: Rays in a row of them.
  """
  constants = {
    **{name: value for name, value in shape.rows._asdict().items() if name != "COUNT"},
    "LEVELS": shape.levels,
    "INPUTS": shape.inputs,
    "WIDTH": shape.width,
    "OUTPUTS": shape.outputs,
    "BOTTLENECK": shape.bottleneck,
    "VIEW": shape.view,
    "VIEW_AT": shape.view_at,
    "RAYS": ray_columns,
    "CAPACITY": CHUNK_SAMPLES,
    "stride": stride,
  }

  def native(body: str) -> Any:
    return wp.func_native(snippet(body, **constants))

  @native(native_grid.PLACE)
  def place(worker: Worker, settings: Settings, begin: int, end: int): ...

  @native(native_grid.ENCODE)
  def encode(worker: Worker, model: Model, begin: int, end: int): ...

  @native(native_network.BASE_FORWARD)
  def base_forward(worker: Worker, model: Model, begin: int, end: int): ...

  @native(native_grid.OPACITY)
  def opacity(worker: Worker, settings: Settings, begin: int, end: int): ...

  # Written out: Warp looks for this decorator in the source where something is returned.
  @wp.func_native(snippet(native_grid.KEEP_VISIBLE, **constants))
  def keep_visible(worker: Worker, rays: int, waiting: int, threshold: float) -> wp.int32: ...

  @native(native_network.VIEW_FORWARD)
  def view_forward(worker: Worker, model: Model, settings: Settings, begin: int, end: int): ...

  @native(native_network.VIEW_BACKWARD)
  def view_backward(worker: Worker, model: Model, begin: int, end: int): ...

  @native(native_network.BASE_BACKWARD)
  def base_backward(worker: Worker, model: Model, begin: int, end: int, kept_at: int): ...

  @native(native_network.NETWORK_GRADIENT)
  def network_gradient(
    worker: Worker, begin: int, end: int, with_view: int, part: int, parts: int
  ): ...

  @native(native_grid.SCATTER)
  def scatter_points(
    gradient: Floats, worker: Worker, model: Model, begin: int, end: int, level: int
  ): ...

  @native(native_grid.ADAM)
  def adam_range(optimised: Optimised, how: AdamW, begin: int, end: int): ...

  @wp.func
  def march_ray(
    grids: Occupancy,
    s: Settings,
    w: Worker,
    seed: wp.uint64,
    index: wp.int64,
    r: int,
    limit: float,
    at: int,
  ):
    """Marches column r of the rays, see march."""
    origin = wp.vec3(w.rays[r], w.rays[ray_columns + r], w.rays[2 * ray_columns + r])
    direction = wp.vec3(
      w.rays[3 * ray_columns + r], w.rays[4 * ray_columns + r], w.rays[5 * ray_columns + r]
    )
    jitter = uniform(seed, index, 5)
    return march(grids, s, origin, direction, jitter, limit, w.work, stride, at)

  return Functions(
    shape=shape,
    stride=stride,
    ray_columns=ray_columns,
    place=place,
    encode=encode,
    base_forward=base_forward,
    opacity=opacity,
    keep_visible=keep_visible,
    view_forward=view_forward,
    view_backward=view_backward,
    base_backward=base_backward,
    network_gradient=network_gradient,
    scatter_points=scatter_points,
    adam_range=adam_range,
    march_ray=march_ray,
    losses=losses.build(shape, stride, ray_columns),
  )
