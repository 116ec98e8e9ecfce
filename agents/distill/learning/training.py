"""Training of a student, stage by stage: what is drawn, which update is called, at which rate."""

from typing import Any

import jax
import numpy as np

from nerf2real.agents.distill import settings as stages
from nerf2real.agents.distill.dataset import Dataset, Streams
from nerf2real.agents.distill.learning import student
from nerf2real.agents.distill.learning.features import FeatureCache
from nerf2real.agents.distill.learning.heads import with_fitted_heads
from nerf2real.agents.distill.learning.updates import make_updates, standardised
from nerf2real.agents.distill.learning.validation import validate
from nerf2real.agents.distill.schedule import cosine
from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.distill.views import mixed
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.processes.timings import StageTimes

Metrics = dict[str, jax.Array]


class Trainer:
  """The student's training state, and the updates of the present stage."""

  def __init__(
    self,
    settings: DistillSettings,
    layout: Layout,
    data: Dataset,
    *,
    seed: int,
    times: StageTimes,
  ):
    """Begins with random weights; assign `state` to continue from another one.

    Args:
      settings: of the distillation.
      layout: the environment's.
      data: labelled episodes; they may become more.
      seed: of first weights, augmentation and sampling.
      times: where the times of sampling and updates are counted.
    """
    self._settings, self._layout, self._data, self._times = settings, layout, data, times
    self._updates = make_updates(settings, layout)
    self.state = self._updates.init(jax.random.PRNGKey(seed))
    self._rng = np.random.default_rng((seed, data.frames))
    width = settings.agent.network.image_features
    self._cache = FeatureCache(
      self._updates.features, data, copies=settings.copies, width=width, seed=seed
    )
    self.views: dict[str, np.ndarray] | None = None  # beside the episodes' pictures
    self._kind = ""
    self._streams: Streams | None = None
    self._carried: Any = None

  def served_parameters(self) -> dict[str, np.ndarray]:
    """Returns the student as flat named arrays."""
    return student.served_parameters(self.state.student, self.state.scales)

  def standardise(self) -> None:
    """Measures the scaling of inputs and labels on the frames that are not held out; fits the heads
    that a policy to begin with does not have."""
    frames = self._training_frames()
    state = standardised(
      self.state,
      state_rows=self._data.arrays["state"][frames],
      labels=self._data.arrays["label"][frames],
      layout=self._layout,
      min_spread=self._settings.min_action_spread,
      keep_policy=bool(self._settings.init_from),
    )
    if self._settings.init_from:
      state = with_fitted_heads(state, self._updates, data=self._data, cache=self._cache)
    self.state = state

  def begin_stage(self, kind: str) -> None:
    """Begins a stage: new streams through the episodes, and features of the present encoder."""
    settings = self._settings
    if kind in stages.OF_FEATURES:
      self._cache.clear()
    count = settings.end_to_end_streams if kind == stages.END_TO_END else settings.streams
    self._kind = kind
    self._streams = Streams(count, settings.unroll, rng=self._rng)
    self._carried = student.initial_state(count, settings.agent.network)

  def update(self, within: float) -> Metrics:
    """Makes one update of the present stage.

    Args:
      within: share of the stage that is over, for the learning rate.
    """
    if self._kind == stages.ENCODER:
      return self._update_encoder(within)
    return self._update_unrolls(within)

  def validate(self) -> dict[str, float]:
    """Returns the errors on held-out episodes."""
    return validate(self.state, self._updates, data=self._data, cache=self._cache)

  def _update_encoder(self, within: float) -> Metrics:
    with self._times.stage("sampling"):
      batch = self._pictures()
    with self._times.stage("update"):
      rate = self._settings.learning_rate * cosine(within)
      self.state, metrics = self._updates.encoder(self.state, batch, rate)
      jax.block_until_ready(metrics)
    return metrics

  def _pictures(self) -> dict[str, np.ndarray]:
    """Returns single frames, of the episodes and of the views."""
    size, views = self._settings.encoder_batch, self.views
    count = 0 if views is None else round(self._settings.views_share * size)
    chosen = self._rng.choice(self._training_frames(), size - count)
    batch = {"image": self._data.arrays["image"][chosen], **self._data.take(chosen)}
    if views is None:
      return batch
    return mixed(batch, views, self._rng.integers(len(views["image"]), size=count))

  def _update_unrolls(self, within: float) -> Metrics:
    assert self._streams is not None
    settings, cached = self._settings, self._kind in stages.OF_FEATURES
    if cached:
      with self._times.stage("features"):
        self._cache.extend(self.state.student["encoder"])
    with self._times.stage("sampling"):
      limit = self._cache.frames if cached else self._data.frames
      spans = [s for s in self._data.spans(held_out=False) if s.end <= limit]
      unroll = self._streams.next(spans)
      batch = self._data.take(unroll.frames)
      batch["begins"] = unroll.begins
      if cached:
        batch["features"] = self._cache.take(unroll.frames, self._rng)
      else:
        batch["image"] = self._data.arrays["image"][unroll.frames]
    with self._times.stage("update"):
      update = getattr(self._updates, self._kind)
      rate = settings.learning_rate if cached else settings.end_to_end_learning_rate
      self.state, self._carried, metrics = update(
        self.state, batch, self._carried, rate * cosine(within)
      )
      jax.block_until_ready(metrics)
    return metrics

  def _training_frames(self) -> np.ndarray:
    """Indices of the frames that are not held out."""
    spans = self._data.spans(held_out=False)
    return np.concatenate([np.arange(span.begin, span.end) for span in spans])
