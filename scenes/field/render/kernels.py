"""The kernels that march rays through a field, in NVIDIA Warp: one source for CPU and CUDA.

A ray's samples lie on a lattice that does not depend on what is skipped: interval i of level j
covers [i, i + 2^j] steps, level j starts at i = growth_steps * 2^j, the sample is its middle.
Empty-space skipping therefore changes the time, not the picture.
"""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import functools
from typing import Any, NamedTuple

import warp as wp

from nerf2real.scenes.field.engine.device import OPTIONS, Device
from nerf2real.scenes.field.engine.native.vectors import snippet
from nerf2real.scenes.field.engine.rays import largest, squash
from nerf2real.scenes.field.render import native
from nerf2real.scenes.field.render.weights import Layout, Packed

MEDIAN = 0.5  # transmittance at which the depth is read
_Result = wp.types.vector(5, wp.float32)  # colour 3, opacity, distance


@wp.struct
class FieldData:
  """A packed field on a device, see `scenes.field.render.weights.Packed`."""

  table: wp.array(dtype=wp.uint32)
  levels: wp.array(dtype=wp.uint32)
  base: wp.array(dtype=wp.float32)
  view: wp.array(dtype=wp.float32)
  variance_step: wp.float32  # interval that the field was trained with [unit]


@wp.struct
class MarchData:
  """How to march, see `renderer.RenderSettings`; cells: distance to matter [cells^3]."""

  distance: wp.array(dtype=wp.uint8)
  cells: wp.int32
  step: wp.float32  # finest interval [unit]
  growth_steps: wp.int32  # intervals of a level before they double
  near: wp.float32  # [unit]
  far: wp.float32  # [unit]
  stop: wp.float32  # transmittance at which a ray ends
  weight_floor: wp.float32  # samples that count less get no colour
  specular_samples: wp.int32  # 1: the view network runs for every sample, 0: once a ray
  pixel_angle: wp.float32  # [rad]


class Kernels(NamedTuple):
  """Compiled for one layout."""

  frame: Any  # poses x rays of a camera -> uint8 colour, z-depth
  rays: Any  # origins, directions -> float colour, distance, opacity
  density: Any  # a lattice in the grid's cube -> densities


@functools.cache
def build(layout: Layout) -> Kernels:
  """Defines the kernels for a field's layout; Warp compiles them at their first launch."""
  outputs = wp.types.vector(layout.outputs, wp.float32)
  view = wp.types.vector(layout.view_width, wp.float32)
  view_constants = {"VIEW": layout.view_width, "BOTTLENECK": layout.bottleneck}

  @wp.func_native(
    snippet(
      native.BASE,
      lanes=1,
      PADDED=layout.padded_levels,
      WIDTH=layout.width,
      OUTPUTS=layout.outputs,
      DENSITY_SCALE=layout.density_scale,
    )
  )
  def base_network(
    table: wp.array(dtype=wp.uint32),
    levels: wp.array(dtype=wp.uint32),
    weights: wp.array(dtype=wp.float32),
    p: wp.vec3,
    v: wp.vec3,
  ) -> outputs: ...

  @wp.func_native(snippet(native.VIEW_HIDDEN, lanes=1, **view_constants))
  def view_hidden(weights: wp.array(dtype=wp.float32), d: wp.vec3) -> view: ...

  @wp.func_native(snippet(native.DIFFUSE, lanes=1))
  def diffuse(base: outputs) -> wp.vec3: ...

  @wp.func_native(snippet(native.SPECULAR, lanes=1, **view_constants))
  def specular(weights: wp.array(dtype=wp.float32), base: outputs, hidden: view) -> wp.vec3: ...

  @wp.func_native(snippet(native.OPACITY, lanes=1))
  def opacity_of(x: wp.float32) -> wp.float32: ...

  @wp.func
  def march(field: FieldData, how: MarchData, origin: wp.vec3, direction: wp.vec3) -> _Result:
    """Colour 3, opacity, distance of the median (inf: none) along a unit direction."""
    cell = 4.0 / wp.float32(how.cells)
    along = wp.cw_mul(direction, direction)
    across = wp.vec3(1.0, 1.0, 1.0) - along
    inverse = wp.vec3()
    cube_exit = wp.float32(1e30)
    for a in range(3):
      inverse[a] = 1.0 / wp.where(wp.abs(direction[a]) > 1e-9, direction[a], 1e-9)
      side = wp.where(direction[a] > 0.0, 1.0, -1.0)
      cube_exit = wp.min(cube_exit, (side - origin[a]) * inverse[a])
    hidden_layer = view_hidden(field.view, direction)

    index = wp.int32(how.near / how.step)
    level = wp.int32(0)
    transmittance = wp.float32(1.0)
    total = wp.vec3()
    mean_base = outputs()
    weights = wp.float32(0.0)
    median = wp.float32(wp.inf)
    while transmittance > how.stop:
      while index >= (2 * how.growth_steps) << level:
        level += 1
        index = (index >> level) << level
      length = how.step * wp.float32(1 << level)
      distance = how.step * (wp.float32(index) + 0.5 * wp.float32(1 << level))
      if distance > how.far:
        break
      position = origin + direction * distance
      norm = largest(position)
      outer = wp.max(norm, 1.0)
      grid = squash(position, outer)
      scaled = grid * wp.float32(how.cells)
      x, y, z = wp.int32(scaled[0]), wp.int32(scaled[1]), wp.int32(scaled[2])
      empty = wp.int32(how.distance[x + how.cells * (y + how.cells * z)])
      if empty > 0:
        clear = wp.float32(0.0)
        if norm < 1.0:
          # To the wall of the cube of empty cells around this one: space is not squashed here.
          corner = wp.vec3(wp.float32(x), wp.float32(y), wp.float32(z)) - scaled
          forward = wp.float32(empty)
          clear = wp.float32(1e30)
          for a in range(3):
            wall = corner[a] + wp.where(direction[a] > 0.0, forward, 1.0 - forward)
            clear = wp.min(clear, wall * inverse[a] * cell)
          clear = wp.min(clear, cube_exit - distance)
        else:
          # Squashing stretches no length by more than 4 / m - 3 / m^2, at most 4 / 3 at m = 1.5;
          # m falls by at most half on the way.
          m = wp.max(1.5, 0.5 * norm)
          clear = wp.min(wp.float32(empty - 1) * cell * m * m / (4.0 * m - 3.0), 0.5 * norm)
        # The next interval is the first whose middle lies behind the clear stretch.
        steps = wp.int32((distance + clear) / length - 0.5) + 1
        index = wp.max(index + (1 << level), steps << level)
        continue

      interval = field.variance_step * outer
      radius = how.pixel_angle * distance
      variance = across * (radius * radius / 12.0) + along * (interval * interval / 12.0)
      base = base_network(field.table, field.levels, field.base, grid, variance)
      thickness = base[0] * length
      alpha = opacity_of(thickness)
      weight = transmittance * alpha
      behind = transmittance - weight
      if weight > how.weight_floor:
        total += weight * diffuse(base)
        if how.specular_samples > 0:
          total += weight * specular(field.view, base, hidden_layer)
        mean_base += weight * base
        weights += weight
      if transmittance > MEDIAN and behind <= MEDIAN:
        median = distance - 0.5 * length + wp.log(transmittance / MEDIAN) / base[0]
      transmittance = behind
      index += 1 << level

    opacity = wp.where(transmittance > how.stop, 1.0 - transmittance, 1.0)
    if weights > 0.0:
      total = total / weights
      if how.specular_samples == 0:
        total += specular(field.view, mean_base / weights, hidden_layer)
      total = total * opacity
    return _Result(total[0], total[1], total[2], opacity, median)

  @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
  def frame(
    field: FieldData,
    how: MarchData,
    poses: wp.array(dtype=wp.mat44),
    rays: wp.array(dtype=wp.vec3),
    color: wp.array(dtype=wp.uint8, ndim=3),
    depth: wp.array(dtype=wp.float32, ndim=2),
  ):
    """One ray a pixel; rays have z = 1 in the camera frame."""
    image, pixel = wp.tid()
    ray = rays[pixel]
    slant = wp.length(ray)
    direction = wp.transform_vector(poses[image], ray) / slant
    origin = wp.transform_point(poses[image], wp.vec3())
    result = march(field, how, origin, direction)
    for channel in range(3):
      color[image, pixel, channel] = wp.uint8(wp.clamp(result[channel] * 255.0 + 0.5, 0.0, 255.0))
    depth[image, pixel] = result[4] / slant

  @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
  def rays(
    field: FieldData,
    how: MarchData,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    color: wp.array(dtype=wp.float32, ndim=2),
    distance: wp.array(dtype=wp.float32),
    opacity: wp.array(dtype=wp.float32),
  ):
    """Unit directions."""
    ray = wp.tid()
    result = march(field, how, origins[ray], directions[ray])
    for channel in range(3):
      color[ray, channel] = result[channel]
    opacity[ray] = result[3]
    distance[ray] = result[4]

  @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
  def density(
    field: FieldData,
    side: wp.int32,
    spacing: wp.float32,
    offset: wp.float32,
    deviations: wp.vec2,
    found: wp.array(dtype=wp.float32),
  ):
    """Density at points of a lattice in the grid's cube, of both sample sizes in turn."""
    point = wp.tid()
    x, y, z = point % side, (point // side) % side, point // (side * side)
    p = wp.vec3(wp.float32(x) + offset, wp.float32(y) + offset, wp.float32(z) + offset) * spacing
    squashed = largest(p - wp.vec3(0.5, 0.5, 0.5)) * 4.0
    norm = wp.where(squashed > 1.0, 1.0 / wp.max(2.0 - squashed, 1e-3), 1.0)
    deviation = deviations[(x + y + z) % 2] * norm
    variance = deviation * deviation
    base = base_network(
      field.table, field.levels, field.base, p, wp.vec3(variance, variance, variance)
    )
    found[point] = base[0]

  return Kernels(frame, rays, density)


def upload(packed: Packed, variance_step: float, device: Device) -> Any:
  """Copies a packed field to a device."""
  data = FieldData()
  data.table = device.put(packed.table)
  data.levels = device.put(packed.levels)
  data.base = device.put(packed.base)
  data.view = device.put(packed.view)
  data.variance_step = variance_step
  return data
