"""Settings of the field's training: every number with its source, and the presets."""

import dataclasses

from nerf2real.scenes.field.field import FieldSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainSettings:
  """Settings of the training. They are stored in the bundle."""

  field: FieldSettings = FieldSettings()
  """The field's shape."""
  engine: str = "fused"
  """"fused": Warp kernels. "jax": the reference, on a GPU where there is one."""
  device: str = "cpu"
  """Where the engine "fused" trains: "cpu" or, with its kernels in phases, "cuda"."""
  max_steps: int | None = None
  """Steps after which training ends, or None."""
  max_seconds: float | None = 290.0
  """Seconds after which training ends, or None. The schedule runs over whichever ends first."""
  learning_rate: float = 1e-2
  """Learning rate after the warm-up. Mueller et al. 2022, section 4; the paper's table: 2e-3. Half
  of it, with a padding of 0.03, is 0.7 dB better after 3,000 steps, and after 15,000 it is worse
  from a robot's camera."""
  final_learning_rate: float = 1e-3
  """Learning rate at the end; the decay is exponential. Chosen: with a third of it, and with the
  paper's padding, held-out views of the built-in room lose 0.6 dB; the paper's table: 4e-5."""
  variance_rate: float = 0.1
  """Factor on the rate of the weights that see the variance. Chosen: it gives away direction and
  distance of the camera, and a field that learns those first finds no geometry. Engine "fused"."""
  warmup_steps: int = 64
  """Steps over which the learning rate rises from a hundredth. Chosen: 1 % of the steps;
  the paper's table: 2048, 5 % of its own."""
  weight_decay: float = 5e-5
  """Decoupled weight decay (AdamW). Paper, NeRF table."""
  adam_beta1: float = 0.9
  """Decay of Adam's first moment. Kingma and Ba 2015."""
  adam_beta2: float = 0.99
  """Decay of Adam's second moment. Mueller et al. 2022, section 4."""
  adam_epsilon: float = 1e-15
  """Adam's constant against division by zero. Mueller et al. 2022, section 4."""
  charbonnier_padding: float = 0.03
  """Padding of the Charbonnier loss, in colours of [0, 1]: smaller errors count as squares. Chosen,
  see `final_learning_rate`; the paper's table: 1e-3."""
  distortion_weight: float = 1e-2
  """Weight of the distortion loss. Paper, NeRF table."""
  distortion_start: int = 1000
  """Step at which the distortion loss sets in; it has its weight at twice this step. Chosen: from
  the start it favours fog before the camera. The paper's table has no such value. Engine "fused";
  the reference has the whole weight from the start."""
  blur_max: float = 12.0
  """Largest blur of a training ray [training pixel]; 0 turns the augmentation off. Paper."""
  blur_sharp_fraction: float = 0.5
  """Fraction of the rays without blur. Chosen: keeps the detail at full resolution."""
  blur_power: float = 1.5
  """Blurred rays draw blur_max * uniform^power. Chosen: most robot cameras lie below half of it."""
  near: float = 0.03
  """Distance where a ray's first sample may lie [unit]. Chosen: no matter within 8 cm of a
  phone."""
  near_gradient: float = 0.0
  """Nearer samples' gradients shrink with the square of their distance [unit]; 0: none do. Philip
  and Deschaintre 2023: 1 in a scene scaled as here. Chosen: with 1 plain walls of a living room
  had less fog before them, but held-out views lost 0.3 dB there and in the built-in room. Engine
  "fused"."""
  random_background: bool = True
  """Composite over a random colour, so that dark surfaces cannot be empty. Mueller et al. 2022."""

  known_steps: int = 1200
  """Steps after which localised points take no part. Chosen: fog forms early, and later their
  errors of a pixel cost 1 dB and more."""
  known_steps_uneven: int = 30_000
  """The same for pictures of changing exposure, which alone never clear the fog. Chosen: a living
  room's held-out views lost 2 dB when its points went after 1,200 steps."""
  anchor_fraction: float = 0.15
  """Fraction of the rays that go to a localised point, where there are any. Chosen, not tuned."""
  anchor_weight: float = 0.3
  """Weight of those rays' distance to their point [normalised distance]: Deng et al. 2022 (depth
  supervision from the sparse points), as a mean absolute error."""

  # Engine "fused".
  planar_fraction: float = 0.4
  """Fraction of the rays that come in threes along a line of a picture, on which surfaces are
  straight where the picture shows nothing: on plain walls no picture tells the depth."""
  planar_weight: float = 0.1
  """Weight of those rays' bend. Chosen in a drawn room of plain walls, where 41 % of the plainest
  pixels are more than 5 cm off with it, 44 % with a third of it, and 60 % without."""
  planar_bend: float = 0.03
  """Second difference of 1 / z, relative to 1 / z, from where on it is an edge. Chosen."""
  planar_contrast: float = 0.05
  """Difference of colours in [0, 1] by which the weight falls to a third. Chosen."""
  planar_reach: float = 0.16
  """Widest angle between two of three [rad]: short threes do not see a wide dent. Chosen: with 0.03
  and a thirtieth of the weight 59 % are off."""
  planar_start: int = 600
  """Step at which they set in: fog has to form surfaces first. Chosen."""
  empty_samples: int = 1024
  """Points a step in cells that sight lines to localised points cross. Chosen: walls without
  texture are explained as well by fog before the cameras."""
  empty_weight: float = 0.01
  """Weight of the mean of log(1 + density) there. Chosen, not tuned."""
  batch_samples: int = 1 << 15
  """Samples a step that are evaluated; the number of rays follows. Chosen for two CPU cores;
  Mueller et al. 2022: 2^18."""
  ray_samples: int = 256
  """Most samples of a ray. Chosen: the finest step then reaches across the unit cube."""
  transmittance_threshold: float = 1e-3
  """Samples behind this much light take no part. Chosen: a quarter of one of 255 levels; Mueller et
  al. 2022: 1e-4."""
  depth_limit: float = 16.0
  """A ray's first march ends where the occupancy grid's optical depth passes this. The grid holds
  each cell's largest density, so that light may be left: then the ray is marched again, four times
  as far. Chosen: 9 to 11 samples a ray in two trained fields; with 8 or 32 a quarter more."""
  refine_samples: float = 24.0
  """The march starts coarse and its step is halved when a ray has fewer samples than this. Chosen,
  not tuned."""
  inner_cells: int = 128
  """Occupancy cells along the unit cube: 4 cm in a room of 5 m. Mueller et al. 2022."""
  outer_cells: int = 64
  """Occupancy cells along the squashed space. Chosen: what lies there is far, and seen coarsely."""
  occupancy_interval: int = 16
  """Steps between updates of the occupancy. Mueller et al. 2022, appendix C."""
  occupancy_start: int = 192
  """Step of the first update; until then nothing counts as empty. Mueller et al. 2022."""
  occupancy_sweep_steps: int = 448
  """Until this step every second update looks at all cells. Chosen: 16 updates."""
  occupancy_samples: int = 1 << 17
  """Cells looked at in an update after that. Chosen: a twentieth of the grid."""
  occupancy_decay: float = 0.8
  """Factor on a cell's density when it is looked at again. Chosen: with a twentieth of the
  grid in an update, fog must go in few looks; Mueller et al. 2022: 0.95."""
  occupancy_threshold: float = 0.01
  """A cell is occupied when a step through it absorbs this fraction. Mueller et al. 2022."""

  # Engine "jax".
  batch_rays: int = 16_384
  """Rays a step. Paper, NeRF table."""
  proposal_samples: int = 64
  """Samples of the proposal network a ray. Paper, NeRF table: 64 x 64."""
  final_samples: int = 64
  """Samples of the field a ray. Paper, NeRF table: 64 x 64."""
  proposal_levels: int = 5
  """Levels of the proposal network's hash grid. As in nerfstudio's nerfacto."""
  proposal_log2_table_size: int = 17
  """Binary logarithm of its entries a level. As in nerfstudio's nerfacto."""
  proposal_finest_resolution: int = 256
  """Cells along an axis of its finest level. As in nerfstudio's nerfacto."""
  proposal_width: int = 64
  """Width of the proposal network. Paper, NeRF table."""
  proposal_depth: int = 2
  """Layers of the proposal network, the last included. Paper, NeRF table."""
  interlevel_weight: float = 1.0
  """Weight of the loss that pulls the proposal over the field. Barron et al. 2022, section 4."""
  sample_dilation: float = 1e-3
  """Proposal weights are spread by this normalised distance. Paper, NeRF table."""

  def last_known_step(self, *, uneven: bool) -> int:
    """Step after which localised points take no part."""
    return self.known_steps_uneven if uneven else self.known_steps

  def distortion_ramp(self, step: int) -> float:
    """Factor on the distortion loss's weight at a step."""
    if self.distortion_start == 0:
      return 1.0
    return min(max(step / self.distortion_start - 1.0, 0.0), 1.0)

  def __post_init__(self):
    if self.engine not in ("fused", "jax"):
      raise ValueError(f"Unknown engine {self.engine!r}; expected 'fused' or 'jax'.")
    limits = [limit for limit in (self.max_steps, self.max_seconds) if limit is not None]
    if not limits or min(limits) <= 0:
      raise ValueError(
        f"Found max_steps={self.max_steps}, max_seconds={self.max_seconds}; expected at least one "
        "step or a positive time."
      )

  def fraction_done(self, steps: int, seconds: float) -> float:
    """Part of the training that is done, by its steps or its seconds, whichever end first."""
    done = [0.0]
    if self.max_steps is not None:
      done.append(steps / self.max_steps)
    if self.max_seconds is not None:
      done.append(seconds / self.max_seconds)
    return max(done)


def preset(name: str) -> TrainSettings:
  """Returns "fast" (5 minutes on two CPU cores), "quality" (an hour) or "paper" (its NeRF table).

  "quality" trains the same field as "fast", so that policies draw it in the same time.
  """
  if name == "fast":
    return TrainSettings()
  if name == "quality":
    return TrainSettings(max_seconds=3600.0)
  if name == "paper":
    return TrainSettings(
      field=FieldSettings(
        levels=12, log2_table_size=20, growth=(2048 / 16) ** (1 / 11), density_gain=1.0
      ),
      engine="jax",
      max_steps=40_000,
      max_seconds=None,
      learning_rate=2e-3,
      final_learning_rate=4e-5,
      warmup_steps=2048,
      charbonnier_padding=1e-3,
      distortion_start=0,
      blur_sharp_fraction=0.0,
      blur_power=1.0,
      anchor_fraction=0.0,
      empty_samples=0,
    )
  raise ValueError(f"Unknown preset {name!r}; expected 'fast', 'quality' or 'paper'.")
