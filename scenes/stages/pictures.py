"""Reads the localised keyframes at training size, with exposures, known points and split."""

import dataclasses

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.field import anchors, photometry
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.stages.cache import Made


@dataclasses.dataclass(frozen=True)
class PosedPictures:
  """The registered keyframes at training size; read anew by every call, as they fill the memory."""

  capture: Made[Capture]
  poses: Made[Localisation]
  width: int
  """Wider pictures are reduced to it [pixel]."""
  held_out_every: int
  """Every so many are kept from training."""

  @property
  def measured(self) -> bool:
    """Whether a sensor measured the keyframes' depth."""
    return self.capture.value.has_depth

  def views(self) -> Views:
    """Reads all pictures.

    Raises:
      ValueError: A keyframe is damaged.
    """
    found = self.poses.value
    camera = found.camera.at_most(self.width)
    images = []
    for index in range(len(found.names)):
      image = found.read_picture(self.capture.value.folder, index)
      if image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
      images.append(image[..., ::-1])
    pictures = np.stack(images)
    seen = photometry.sightings(found, pictures, camera)
    exposure = photometry.fit_exposure(seen, count=len(images)).for_range(pictures, camera)
    known = anchors.known_points(found, camera)
    known = np.concatenate([known, self._measured(camera)])
    return Views(camera, pictures, found.world_from_camera, found.names, exposure, anchors=known)

  def _measured(self, camera: Camera) -> np.ndarray:
    """Depth that a sensor measured, as anchors float32 [A, 4] of pictures of a camera's size."""
    source, found = self.capture.value.known, self.poses.value
    if source is None or not len(source.sightings):
      return np.zeros((0, 4), np.float32)
    row = np.full(len(self.capture.value.images), -1)
    row_of = {name: k for k, name in enumerate(found.names)}
    for k, path in enumerate(self.capture.value.images):
      row[k] = row_of.get(path.name, -1)
    seen = source.with_views(
      found.camera.resized(source.camera.width, source.camera.height), source.world_from_camera
    ).sightings
    seen[:, 0] = row[seen[:, 0].astype(int)]
    pixels = seen[:, 1:3] * camera.size_ratio(source.camera)
    seen[:, 1:3] = np.minimum(np.floor(pixels), [camera.width - 1, camera.height - 1])
    seen[:, 3] *= found.unit_from_source.scale
    return seen[seen[:, 0] >= 0].astype(np.float32)

  def training(self) -> Views:
    """Reads the pictures that are trained on."""
    return self.views().split(self.held_out_every)[0]

  def held_out(self) -> Views:
    """Reads the pictures that are kept from training."""
    return self.views().split(self.held_out_every)[1]
