"""A field's parameters on a device, laid out for the fused kernels, and densities from them."""

from typing import Any

import numpy as np

from nerf2real.scenes.field import encoding
from nerf2real.scenes.field.engine import layout
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.field import FieldSettings, Params

LINE = 16  # float32 numbers in a cache line


def flatten(settings: FieldSettings, params: Params) -> np.ndarray:
  """Packs the networks' parameters into one vector, zeros behind up to a multiple of 16."""
  names = [name for name in settings.shapes if name != "table"]
  flat = np.concatenate([np.asarray(params[name], np.float32).ravel() for name in names])
  return np.pad(flat, (0, -len(flat) % LINE))


def unflatten(settings: FieldSettings, flat: np.ndarray) -> dict[str, Any]:
  """Inverts `flatten`."""
  params, at = {}, 0
  for name, shape in settings.shapes.items():
    if name != "table":
      size = int(np.prod(shape))
      params[name] = flat[at : at + size].reshape(shape).copy()
      at += size
  return params


def upload(settings: FieldSettings, params: Params, device: Device) -> Any:
  """Copies a field's parameters to a device: a `layout.Model`."""
  model: Any = layout.Model()
  model.table = device.put(np.asarray(params["table"], np.float32).ravel())
  model.weights = device.put(flatten(settings, params))
  model.entries = 2**settings.log2_table_size
  rows = encoding.level_rows(settings.resolutions, model.entries)
  model.levels = device.put(rows.ravel().view(np.int32))
  return model


def download(settings: FieldSettings, model: Any) -> dict[str, Any]:
  """Returns copies of a model's parameters by name."""
  params = unflatten(settings, model.weights.numpy())
  params["table"] = model.table.numpy().reshape(settings.shapes["table"]).copy()
  return params


def make_worker(
  shape: layout.Shape, device: Device, *, stride: int, columns: int, kept: int
) -> Any:
  """Allocates a `layout.Worker`.

  Args:
    shape: The field's shape.
    device: Where.
    stride: Samples that the work arrays hold.
    columns: Rays that they hold.
    kept: Samples that are kept for the table's gradient.
  """
  work = np.zeros((shape.rows.COUNT, stride), np.float32)
  work[list(shape.ones)] = 1
  worker: Any = layout.Worker()
  worker.work = device.put(work.ravel())
  worker.rays = device.zeros(layout.RAY_ROWS * columns)
  worker.ray_of = device.zeros(stride, np.int32)
  worker.first = device.zeros(columns + 1, np.int32)
  worker.last = device.zeros(columns, np.int32)
  worker.number = device.zeros(columns, np.int32)
  worker.again = device.zeros(columns, np.int32)
  worker.gradient = device.zeros(shape.parameters + -shape.parameters % LINE)
  worker.kept = device.zeros((3 + 2 * shape.levels) * kept)
  worker.kept_stride = kept
  worker.figures = device.zeros(6, np.float64)
  return worker
