"""Whole trainings with the fused kernels, in chunks and in phases."""

import dataclasses

import numpy as np
import pytest

from nerf2real.scenes.field import training as train
from nerf2real.scenes.field.engine.trainer import FusedTrainer
from nerf2real.scenes.field.occupancy import OccupancySettings, build
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.quality import image_quality
from tests.scenes import box_views

# in so few steps a higher rate at the end leaves fog, in phases
FAST = dataclasses.replace(box_views.TRAINING, final_learning_rate=3e-4)


@pytest.fixture(scope="module")
def views():
  return box_views.make_views(60, width=64, height=48)


def _train(views, steps=FAST.max_steps, **options):
  trainer = FusedTrainer(views, FAST, seed=0, **options)
  for step in range(steps):
    trainer.step(train.learning_rate(FAST, step / FAST.max_steps, step))
  return trainer


@pytest.mark.parametrize("phased", [False, True])
def test_training_reproduces_views_it_has_not_seen(views, phased):
  held_out = box_views.make_views(3, width=64, height=48, seed=100)
  field = _train(views, phased=phased).field()
  renderer = Renderer(field, occupancy=build(field, settings=OccupancySettings(cells=64)))
  figures = []
  for index in range(3):
    picture, depth = renderer.render(held_out.camera, held_out.world_from_camera[index])
    figures.append(image_quality.psnr(picture, held_out.images[index]))
    origin, directions = box_views.rays(held_out, index)
    z = held_out.camera.rays()
    truth = box_views.wall_distance(origin, directions) / np.linalg.norm(z, axis=-1)
    assert np.median(np.abs(depth - truth)) < 0.1
  assert np.mean(figures) > 25
