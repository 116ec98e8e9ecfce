"""Parameters, work arrays and compiled kernels of a field on a device; densities from them."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import warp as wp

from nerf2real.scenes.field import encoding
from nerf2real.scenes.field.engine import chunks, layout, parameters, phases
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.engine.functions import build
from nerf2real.scenes.field.field import FieldSettings, Params


class Engine:
  """A field on a device, ready for the kernels: one set of work arrays a thread."""

  def __init__(
    self,
    settings: FieldSettings,
    params: Params,
    device: Device,
    *,
    stride: int = layout.STRIDE,
    columns: int = layout.CHUNK_RAYS,
    kept: int = 0,
  ):
    """Uploads a field.

    Args:
      settings: The field's shape.
      params: Its parameters by name.
      device: Where to.
      stride: Samples that a set of work arrays holds.
      columns: Rays that it holds.
      kept: Samples that it keeps for the table's gradient.

    Raises:
      ValueError: For a shape that the kernels cannot run.
    """
    self.shape = layout.Shape.of(settings)
    self.device = device
    self.stride = stride
    functions = build(self.shape, stride, columns)
    self.chunks = chunks.build(functions)
    self.phases = phases.build(functions)
    self.model = parameters.upload(settings, params, device)
    numbers: Any = layout.Settings()
    self.numbers = numbers
    numbers.density_gain = settings.density_gain
    numbers.density_bias = settings.density_bias
    numbers.density_scale = settings.density_scale
    numbers.specular_bias = settings.specular_bias
    numbers.variance_step = settings.march_step
    self.workers = [
      parameters.make_worker(self.shape, device, stride=stride, columns=columns, kept=kept)
      for _ in range(device.threads)
    ]
    self.worker_array: Any = wp.array(self.workers, dtype=layout.Worker, device=device.name)

  def densities(self, positions: np.ndarray, *, sigma: float) -> np.ndarray:
    """Densities [...] [1/unit] at positions [..., 3], averaged over a standard deviation [unit]."""
    device = self.device
    device.load(self.chunks.densities)
    points = np.ascontiguousarray(positions, np.float32).reshape(-1, 3)
    stretches = device.share(len(points))
    size, lanes = (layout.CHUNK_SAMPLES, 1) if device.is_cpu else (1, self.stride)
    places, result = device.put(points, wp.vec3), device.zeros(len(points))
    extent = float(encoding.variance_features(jnp.float32(sigma**2)))

    def work(thread: int) -> None:
      fixed = [self.numbers, self.model, self.worker_array, thread, size, lanes, places, extent]
      device.launch(self.chunks.densities, [*fixed, *stretches[thread], result], dim=lanes)

    device.run(work)
    return result.numpy().reshape(positions.shape[:-1])
