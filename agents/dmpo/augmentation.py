"""Random changes of the pictures in training; one draw serves a whole trajectory.

Source: Byravan et al. 2022 (NeRF2Real), appendix, table "Image augmentation settings": dm_pix's
random brightness, hue, contrast and saturation, and translations by up to 5 % of height and width.
The paper names no order; here it is brightness, hue, contrast, saturation, then the translation.

Shape letters: B trajectories, T time, H, W picture.
"""

import dm_pix
import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo.config import AugmentationConfig
from nerf2real.agents.dmpo.shapes import check_shapes


def augment(key: jax.Array, images: jax.Array, config: AugmentationConfig) -> jax.Array:
  """Augments pictures in [0, 1] [B, T, H, W, 3]: each trajectory with one draw of its own."""
  check_shapes(images=(images, 5))
  if not config.enabled:
    return images
  keys = jax.random.split(key, images.shape[0])
  return jax.vmap(lambda k, x: augment_trajectory(k, x, config))(keys, images)


def augment_trajectory(key: jax.Array, images: jax.Array, config: AugmentationConfig) -> jax.Array:
  """Augments the pictures of one trajectory [T, H, W, 3] with a single draw."""
  brightness, hue, contrast, saturation, shift = jax.random.split(key, 5)
  delta = jax.random.uniform(brightness, minval=-config.brightness, maxval=config.brightness)
  x = dm_pix.adjust_brightness(images, delta)
  x = dm_pix.adjust_hue(x, jax.random.uniform(hue, minval=-config.hue, maxval=config.hue))
  low, high = config.contrast
  # Contrast turns about the mean of each picture, as dm_pix defines it.
  factor = jax.random.uniform(contrast, minval=low, maxval=high)
  x = jax.vmap(lambda image: dm_pix.adjust_contrast(image, factor))(x)
  low, high = config.saturation
  x = dm_pix.adjust_saturation(x, jax.random.uniform(saturation, minval=low, maxval=high))
  return translate(shift, jnp.clip(x, 0.0, 1.0), config.translation)


def translate(key: jax.Array, images: jax.Array, fraction: float) -> jax.Array:
  """Shifts pictures [T, H, W, 3] by whole pixels, up to a fraction of the size; edges repeat."""
  height, width = images.shape[1:3]
  reach_y, reach_x = round(fraction * height), round(fraction * width)
  key_y, key_x = jax.random.split(key)
  shift_y = jax.random.randint(key_y, (), -reach_y, reach_y + 1)
  shift_x = jax.random.randint(key_x, (), -reach_x, reach_x + 1)
  rows = jnp.clip(jnp.arange(height) + shift_y, 0, height - 1)
  columns = jnp.clip(jnp.arange(width) + shift_x, 0, width - 1)
  return images[:, rows][:, :, columns]
