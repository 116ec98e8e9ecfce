"""A student that begins with an exported policy acts as that policy did, and is trained on."""

import dataclasses

import jax
import numpy as np
import pytest

from nerf2real.agents.distill import settings
from nerf2real.agents.distill.learning import beginning, student
from nerf2real.agents.distill.learning.updates import make_updates, standardised
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.core.serialization import to_plain
from nerf2real.launch import distill_learner
from tests.agents.distill.test_student import LAYOUT, TINY, make_state


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
  """A folder with the export of a student with scales of its own."""
  folder = tmp_path_factory.mktemp("policy")
  _, state = make_state(seed=4)
  export.export_policy(
    folder,
    student.served_parameters(state.student, state.scales),
    layout=LAYOUT,
    environment="suite:nerf_nav",
    settings=to_plain(dataclasses.replace(TINY.agent, history=1)),
    info={},
  )
  return folder


def _act(policy, seed=0):
  rng = np.random.default_rng(seed)
  carried, actions = policy.initial_state(), []
  for _ in range(5):
    image = rng.integers(0, 256, (12, 16, 3), np.uint8)
    step = policy.step(image, rng.normal(3.0, 2.0, 5).astype(np.float32), carried)
    carried = step.state
    actions.append(np.concatenate([step.mean, policy.belief(step.embedding)[1].ravel()]))
  return np.array(actions)


def test_it_acts_as_the_policy_did_also_once_inputs_are_standardised(exported):
  updates = make_updates(TINY, LAYOUT)
  state = beginning.begin_with(updates.init(jax.random.PRNGKey(9)), export.load_arrays(exported))
  rows = np.random.default_rng(1).normal(2.0, 3.0, (99, 5))
  labels = np.random.default_rng(2).normal(0.3, 0.2, (99, 4)).astype(np.float32)
  scaled = standardised(
    state, state_rows=rows, labels=labels, layout=LAYOUT, min_spread=0.05, keep_policy=True
  )
  wanted = _act(export.load_policy(exported).policy)
  for begun in (state, scaled):
    served = student.served_parameters(begun.student, begun.scales)
    np.testing.assert_allclose(
      _act(Policy.of_network(served, TINY.agent.network)), wanted, atol=1e-4
    )
  assert np.abs(np.asarray(scaled.scales["state"]["mean"]) - 2.0).max() < 1.5  # of the new data
  fresh = standardised(state, state_rows=rows, labels=labels, layout=LAYOUT, min_spread=0.05)
  served = student.served_parameters(fresh.student, fresh.scales)
  assert np.abs(_act(Policy.of_network(served, TINY.agent.network)) - wanted).max() > 0.05


def test_other_networks_are_refused_with_the_array(exported):
  other = make_updates(settings.nerf_nav(), LAYOUT).init(jax.random.PRNGKey(0))
  with pytest.raises(ValueError, match=r"other networks: for \S+ found \(.*, expected \("):
    beginning.begin_with(other, export.load_arrays(exported))
  arrays = export.load_arrays(exported)
  state = make_updates(TINY, LAYOUT).init(jax.random.PRNGKey(0))
  without = {name: array for name, array in arrays.items() if "resnet" not in name}
  with pytest.raises(ValueError, match="policy/resnet/.* found nothing"):
    beginning.begin_with(state, without)


def test_a_run_takes_the_networks_of_the_policy_it_begins_with(exported, tmp_path):
  arguments = distill_learner.Arguments(run=tmp_path, preset="adapt", init_from=exported)
  found = distill_learner.settings_of(arguments)
  assert found.agent.network == TINY.agent.network and found.init_from == str(exported)
  assert found.stages == settings.preset("adapt").stages
  missing = distill_learner.Arguments(run=tmp_path, init_from=tmp_path)
  with pytest.raises(ValueError, match="holds no policy.json"):
    distill_learner.settings_of(missing)
