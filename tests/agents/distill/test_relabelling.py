"""Episodes of an earlier run that are labelled anew."""

import dataclasses

import numpy as np
import pytest

from nerf2real.agents.distill import relabelling, schedule, settings
from nerf2real.agents.distill import teacher as teachers
from nerf2real.agents.distill.collecting import episodes
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment


@pytest.fixture(scope="module")
def world():
  """An environment, its layout, and an episode that the walker `quick` drove with noise."""
  name = settings.preset("tiny").environment + "&pushes=false"
  environment = make_environment(name, seed=0)
  layout = Layout.of(environment)
  runner = episodes.EpisodeRunner(
    environment,
    layout,
    teacher=teachers.make_teacher("quick", task_of(environment).scene),
    settings=settings.MixtureSettings(detour_share=0.0, segment=(5, 9)),
    rng=np.random.default_rng(0),
  )
  episode, _ = runner.run(None, schedule.Mixture(1.0, 0.0))
  return environment, layout, episode


def test_the_same_teacher_labels_as_it_did(world):
  environment, layout, episode = world
  quick = teachers.make_teacher("quick", task_of(environment).scene)
  found = relabelling.relabelled(episode, layout, quick)
  assert found["label"] == pytest.approx(episode["label"], abs=2e-3)
  assert found["command"] == pytest.approx(episode["command"], abs=1e-3)


def test_another_teacher_labels_otherwise_and_the_rest_stays(world, tmp_path):
  environment, layout, episode = world
  source, target = tmp_path / "earlier", tmp_path / "data"
  source.mkdir()
  target.mkdir()
  np.savez(source / "000000_0000000000000001_1.npz", **episode)
  steady = teachers.make_teacher("steady", task_of(environment).scene)
  frames = relabelling.relabel(source, target, layout=layout, teacher=steady)
  assert frames == len(episode["state"])
  with np.load(target / "000000_0000000000000001_1.npz") as stored:
    changed = {name for name in episode if not np.array_equal(stored[name], episode[name])}
    assert set(stored.files) == set(episode) and {"label"} <= changed <= {"label", "command"}


def test_other_environments_and_empty_folders_are_refused(world, tmp_path):
  environment, layout, episode = world
  teacher = teachers.make_teacher("steady", task_of(environment).scene)
  with pytest.raises(ValueError, match="holds no episodes"):
    relabelling.relabel(tmp_path, tmp_path, layout=layout, teacher=teacher)
  np.savez(tmp_path / "000000_0000000000000001_1.npz", **episode)
  other = dataclasses.replace(layout, image_shape=(30, 40, 3))
  with pytest.raises(ValueError, match="another environment"):
    relabelling.relabel(tmp_path, tmp_path / "data", layout=other, teacher=teacher)
  path = tmp_path / "000000_0000000000000001_1.npz"
  path.write_bytes(path.read_bytes()[:100])
  with pytest.raises(ValueError, match=f"{path.name} is no episode"):
    relabelling.relabel(tmp_path, tmp_path / "data", layout=layout, teacher=teacher)
