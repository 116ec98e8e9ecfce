"""What a film's map lacks is placed beside what is held."""

import numpy as np
import pycolmap
import pytest

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.film import continuity, motion_prior
from nerf2real.scenes.poses.film.completion import complete
from nerf2real.scenes.poses.localisation import poses_of
from nerf2real.scenes.poses.mapping import registered
from tests.scenes import synthetic_capture as synthetic

MIDDLE = slice(3, 5)  # pictures that have no place


@pytest.fixture
def film(folder):
  """A map without the middle of its film, the rest of `complete`'s arguments, and the names."""
  model = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  names = [image.name for image in registered(model)]
  for image in registered(model)[MIDDLE]:
    model.deregister_frame(image.frame_id)
  times = {name: 0.3 * k for k, name in enumerate(names)}
  return model, (folder / "out" / "work" / "database.db", folder / "images", times), names


def test_the_middle_of_a_film_gets_its_place(film):
  model, rest, names = film
  found, lost = complete(model, *rest, seed=0)
  assert [image.name for image in registered(found)] == names and not lost
  truth = synthetic.walk(8)[:, :3, 3]
  places = poses_of(registered(found))[:, :3, 3]
  off = np.linalg.norm(Similarity.fit(places, truth).apply(places) - truth, axis=1)
  assert off.max() < 0.004
  assert model.num_reg_images() == len(names) - 2  # the map that was given is as it was


def test_the_line_judges_what_is_held(film, monkeypatch):
  model, rest, _ = film
  held, judged = pycolmap.Reconstruction(model), []
  monkeypatch.setattr(motion_prior, "hold", lambda *args, **options: held)

  def drop(found, database, times):
    judged.append(found)
    return continuity.OutOfLine(frozenset(), frozenset())

  monkeypatch.setattr(continuity, "drop_out_of_line", drop)
  assert complete(model, *rest, seed=0) == (held, frozenset())
  assert judged == [held]


def test_what_is_out_of_line_loses_its_place_again(film, monkeypatch):
  model, rest, names = film

  def drop(found, database, times):
    image = registered(found)[4]
    found.deregister_frame(image.frame_id)
    return continuity.OutOfLine(frozenset([image.name]), frozenset())

  monkeypatch.setattr(continuity, "drop_out_of_line", drop)
  found, lost = complete(model, *rest, seed=0)
  assert lost == {names[4]}
  assert {image.name for image in registered(found)} == set(names) - lost


def test_a_line_that_leaves_out_more_than_it_gains_is_not_taken(film, monkeypatch):
  model, rest, _ = film

  def drop(found, database, times):
    for image in registered(found)[:3]:
      found.deregister_frame(image.frame_id)
    return continuity.OutOfLine(frozenset("abc"), frozenset())

  monkeypatch.setattr(continuity, "drop_out_of_line", drop)
  assert complete(model, *rest, seed=0) == (model, frozenset())


def test_a_whole_map_stays_as_it_is(folder):
  model = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  times = {image.name: 0.3 * k for k, image in enumerate(registered(model))}
  database = folder / "out" / "work" / "database.db"
  assert complete(model, database, folder / "images", times, seed=0) == (model, frozenset())
