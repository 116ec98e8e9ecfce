"""Settings of a distillation, and its presets.

A unit is given where there is one; everything else is a pure number. Where no source is named, the
value is chosen and the reason is given.
"""

import dataclasses
from collections.abc import Callable, Mapping

from nerf2real.agents.dmpo.config import AugmentationConfig, DmpoConfig, NetworkConfig

ENCODER, POLICY, WALK, END_TO_END = "encoder", "policy", "walk", "end_to_end"
STAGES = (ENCODER, POLICY, WALK, END_TO_END)
OF_FEATURES = (POLICY, WALK)  # stages that train on cached features; their students may act
SETTINGS = "settings.json"  # in a run's folder
KIND = "distillation"  # of run, in the learner's description


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stage:
  """A part of the training."""

  kind: str
  """"encoder": pictures to poses, single frames; "policy": LSTM, MLP and belief on cached features
  of the frozen encoder; "walk": the MLP alone, LSTM and belief are frozen, too; "end_to_end":
  everything on recurrent unrolls."""
  share: float
  """Of the run's time."""

  def __post_init__(self):
    if self.kind not in STAGES:
      raise ValueError(f"kind must be one of {', '.join(STAGES)}, found {self.kind!r}.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MixtureSettings:
  """Who drives while data are collected: DAgger's mixture (Ross et al. 2011), in segments."""

  first_share: float = 1.0
  """The teacher's share of the segments until the run's first own student is there, where one from
  elsewhere drives beside it, and then."""
  last_share: float = 0.15
  """And in the end; not 0, so that the data keep showing how it should be done."""
  anneal_frames: int = 60_000
  """Frames over which the share falls [steps]: about three of the usual rounds of DAgger."""
  segment: tuple[int, int] = (30, 120)
  """Shortest and longest segment with one driver [steps]."""
  detour_share: float = 0.15
  """Of the segments that a second teacher drives to another place: what follows is turning."""
  noise: float = 0.15
  """Standard deviation of the noise on a driving teacher's actions; drawn up to this value. From
  0.2 on most episodes of the walker end in a fall."""
  noisy_share: float = 0.6
  """Of the teacher's segments that are noisy at all."""
  belief_share: float = 0.4
  """Of the episodes, in the end, whose teacher is given the student's belief in place of the true
  pose: labels that a student can follow, for they depend on nothing that it lacks. Grows from 0 as
  the teacher's share falls."""
  covered_share: float = 0.0
  """Of the segments in which the camera is covered: the belief jumps, and the walk must not."""
  after_success: int = 20
  """Steps that an episode goes on after its success: data close to the goal [steps]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistillSettings:
  """What is distilled, and how."""

  environment: str
  """Where data are collected, as `agents.environments.loading` names it, without pushes."""
  teacher: str = "quick"
  """One of `teacher.TEACHERS`, a walker's settings as JSON, or the folder of an exported policy."""
  init_from: str = ""
  """Folder of an exported policy that the student begins with; random weights if empty."""
  agent: DmpoConfig = DmpoConfig(network=NetworkConfig(init_stddev=0.1))
  """The student's networks and augmentation; the exported policy carries them. Noise of 0.1 leaves
  a walking robot on its feet, so that DMPO may go on from the student."""
  mixture: MixtureSettings = MixtureSettings()
  """Who drives."""
  push_forces: tuple[tuple[int, float, float], ...] = ((0, 0.0, 0.0),)
  """From which frame on pushes of which forces are drawn [steps, N, N]; no pushes below 1e-6 N."""
  stages: tuple[Stage, ...] = (
    Stage(kind=ENCODER, share=0.13),
    Stage(kind=POLICY, share=0.17),
    Stage(kind=ENCODER, share=0.15),
    Stage(kind=POLICY, share=0.27),
    Stage(kind=END_TO_END, share=0.28),
  )
  """Parts of the run, one after another; the encoder learns again when the student's own paths are
  in the data."""

  settling: int = 600
  """Updates of a policy stage, or all of a shorter one, before its student is given out: it has to
  get used to the encoder first [updates]."""
  first_frames: int = 8_000
  """Frames before training begins [steps]: some 15 episodes; inputs are standardised on them."""
  max_frames: int = 400_000
  """Frames collected at most [steps]: 5 kB each in memory."""
  teacher_frames: int = 200_000
  """Frames collected at most before the run's first own student is there [steps]: a fast collector
  would fill the data set with the teacher's own paths, or with those of the student that the run
  begins with, and none would show how its own errs."""
  holdout: int = 10
  """Every episode of that number is held out for validation."""
  learning_rate: float = 1e-3
  """Adam's step in the encoder and policy stages, falling along a cosine to 2 % in each."""
  end_to_end_learning_rate: float = 3e-4
  """Adam's first step end to end: smaller, all is trained already."""
  max_gradient_norm: float = 1.0
  """Clip of the gradient's global norm."""
  encoder_batch: int = 128
  """Pictures in an update of the encoder stage."""
  unroll: int = 24
  """Steps of a recurrent unroll [steps]; the state is carried from one to the next."""
  streams: int = 64
  """Unrolls in an update on cached features."""
  end_to_end_streams: int = 12
  """Unrolls in an update end to end."""
  views: int = 0
  """Pictures rendered at drawn places besides those of the episodes (`views`), for the encoder."""
  views_share: float = 0.5
  """Of the pictures in an update of the encoder stage, where there are views; chosen."""
  view_scenes: tuple[str, ...] = ()
  """Folders of other reconstructions of the same room, with the same origin (one marker): views are
  rendered in them, too, the same number in each."""
  copies: int = 2
  """Augmented copies of which features are cached."""
  pose_weight: float = 0.3
  """Of the pose's loss beside the actions'. As in a trial that gave 56 % (README)."""
  ball_weight: float = 0.3
  """Of the loss of the ball's place, where there is a ball; chosen: as the pose's."""
  command_weight: float = 0.1
  """Of the loss of the teacher's command (forward, turn)."""
  belief_weight: float = 0.02
  """Of the belief's negative log-likelihood, some nats; its gradient stays in its own head."""
  turn_emphasis: float = 1.0
  """Weight that a full turning command adds to a frame's action loss."""
  min_action_spread: float = 0.05
  """Smallest spread by which an action is scaled in the loss: a head that never moves must not be
  magnified without bound."""
  blind_radius: float = 0.13
  """Distance from the goal within which labels count nothing [m]: the teacher halts where a student
  whose localisation errs by as much cannot infer that it should."""

  publish_period: float = 15.0
  """Time between students given to the collectors [s]."""
  save_period: float = 60.0
  """Time between saved states of the learner [s]."""
  keep_minutes: float = 0.0
  """Training time between students that are kept beside the newest [min]; 0: none is."""
  log_period: float = 15.0
  """Time between rows of metrics [s]."""
  evaluation_period: float = 480.0
  """Time between evaluations during the run [s]."""
  evaluation_trials: int = 18
  """Trials of an evaluation during the run; none of them is a trial of the protocol."""

  def __post_init__(self):
    total = sum(stage.share for stage in self.stages)
    if abs(total - 1.0) > 1e-6:
      raise ValueError(f"The stages' shares must sum to 1, found {total:g}.")
    if self.keep_minutes < 0:
      raise ValueError(f"keep_minutes must be 0 or more, found {self.keep_minutes:g}.")
    for name in ("max_frames", "teacher_frames"):
      if getattr(self, name) < self.first_frames:
        raise ValueError(
          f"{name} must be {self.first_frames} (first_frames) or more, found "
          f"{getattr(self, name)}: training would wait for frames that nobody collects."
        )


def nerf_nav() -> DistillSettings:
  """Navigation: the walker distilled into the paper's policy network."""
  return DistillSettings(
    environment="suite:nerf_nav",
    # The suite's usual 5 to 15 N fell two of three of the walker's own episodes.
    push_forces=((0, 0.0, 0.0), (80_000, 1.0, 3.0), (160_000, 2.0, 6.0)),
  )


def adapt() -> DistillSettings:
  """Navigation: a student that walks already is trained on, in minutes, where something changed."""
  return DistillSettings(
    environment="suite:nerf_nav",
    mixture=MixtureSettings(first_share=0.5, anneal_frames=20_000),
    # What the change asks of the encoder, the middle part gives: its data are the new student's.
    stages=(
      Stage(kind=POLICY, share=0.3),
      Stage(kind=ENCODER, share=0.25),
      Stage(kind=POLICY, share=0.45),
    ),
    settling=300,
    first_frames=4_000,
    learning_rate=3e-4,
    evaluation_period=3_600.0,
  )


def nerf_nav_on() -> DistillSettings:
  """Navigation: a student that walks already is trained on towards a faster walk, and on views.

  What it begins from is `--init-from`. The second step of the shipped policy was made with
  it, from the student of `nerf_nav`, which collided after starts at which its belief was wrong from
  the first picture on: an episode shows one start, views show a place each. It needs a quarter to a
  third less time than that one and fails as often, still after such starts.
  """
  return dataclasses.replace(
    adapt(),
    teacher="swift",
    views=20_000,
    # As in `ball_push_on`: views teach the encoder before there are new paths of the student's.
    stages=(Stage(kind=ENCODER, share=0.35), Stage(kind=POLICY, share=0.65)),
    # The encoder has the views: time is better spent on its updates than on more of the old paths.
    teacher_frames=60_000,
  )


def nerf_nav_faster() -> DistillSettings:
  """Navigation: a student that walks already learns a faster teacher's walk, and only that.

  What it sees and where it believes to be are right already; encoder and memory stay as they are.
  Students whose LSTM was fitted anew to the few frames of such a run knew their place less well,
  above all in its first seconds (benchmarks/results/policies/navigation_faster.md). For pictures of
  60x80: `--env "suite:nerf_nav?image_size=60x80"`.
  """
  return dataclasses.replace(
    adapt(),
    teacher="nimble",
    # Of trials with the camera covered for a while a student that had met none fell in half.
    mixture=dataclasses.replace(adapt().mixture, covered_share=0.15),
    stages=(Stage(kind=WALK, share=1.0),),
    max_frames=250_000,  # of 60x80 16 kB each in memory
  )


def room() -> DistillSettings:
  """Navigation: a student of one room is trained on in another, which looks different."""
  return dataclasses.replace(
    adapt(),
    teacher="swift",
    mixture=MixtureSettings(first_share=0.7),
    # It walks already and must learn where it is; the shares of `ball_push`, for the same reasons,
    # and the views of `nerf_nav_on`: a start in a corner where no path led is seen there.
    stages=ball_push().stages,
    views=20_000,
    settling=600,
    first_frames=8_000,
    teacher_frames=60_000,
    learning_rate=1e-3,
    evaluation_period=1_500.0,
  )


def ball_push() -> DistillSettings:
  """Ball pushing: the walker whose head follows the ball."""
  return DistillSettings(
    # A ball of one colour in one light was all that an encoder knew (benchmarks/results).
    environment="suite:ball_push?light=true",
    teacher="ball",
    views=20_000,
    # The goal is the ball's: the robot's distance from it takes nothing from a label.
    blind_radius=0.0,
    push_forces=((0, 0.0, 0.0), (80_000, 1.0, 3.0)),
    # Pictures hold two things to find here, the robot's place and the ball's; no part is trained
    # end to end, which made the student of navigation no better.
    stages=(
      Stage(kind=ENCODER, share=0.25),
      Stage(kind=POLICY, share=0.2),
      Stage(kind=ENCODER, share=0.2),
      Stage(kind=POLICY, share=0.35),
    ),
    # A trial takes up to a minute of the robot's time.
    evaluation_period=1_500.0,
    evaluation_trials=12,
  )


def ball_push_on() -> DistillSettings:
  """Ball pushing: a student that walks already is trained on, mostly on what it does itself."""
  return dataclasses.replace(
    ball_push(),
    mixture=MixtureSettings(first_share=0.5, anneal_frames=20_000),
    # Views teach the encoder before there are new paths of the student's: once is enough.
    stages=(Stage(kind=ENCODER, share=0.25), Stage(kind=POLICY, share=0.75)),
    first_frames=4_000,
    # Until the encoder has learned, the student that the run begins with is lost where more is
    # drawn than it knows.
    teacher_frames=40_000,
    evaluation_period=3_600.0,
  )


def nerf_nav_60x80() -> DistillSettings:
  """Navigation with pictures of 60x80, the paper's larger resolution, in one run from nothing.

  The encoder has a section more and half the blocks: 9.3 million multiplications a picture, as
  many as the usual one takes at 30x40 (with the usual one: four times as many). Teacher, views and
  parts are those that made the shipped policy of 30x40 faster (`nerf_nav_on`) and that of the ball
  (`ball_push`); no part is trained end to end, which made the student of 30x40 no better.
  """
  network = NetworkConfig(image_channels=(8, 16, 32, 32), image_blocks=1, init_stddev=0.1)
  return dataclasses.replace(
    nerf_nav(),
    environment="suite:nerf_nav?image_size=60x80",
    teacher="swift",
    agent=DmpoConfig(network=network),
    views=20_000,
    stages=ball_push().stages,
    max_frames=200_000,  # 16 kB each in memory
    teacher_frames=60_000,  # as in `nerf_nav_on`, and the slower pictures leave fewer in all
  )


def tiny() -> DistillSettings:
  """Everything very small: to try the machinery in seconds."""
  network = NetworkConfig(
    policy_layers=(16, 16),
    image_channels=(2, 2),
    image_blocks=1,
    image_features=8,
    lstm_size=8,
    belief_layers=(8,),
    belief_components=2,
    init_stddev=0.1,
  )
  return DistillSettings(
    environment="suite:nerf_nav?image_size=12x16&time_limit=1",
    agent=DmpoConfig(network=network, augmentation=AugmentationConfig()),
    mixture=MixtureSettings(anneal_frames=100, segment=(5, 10)),
    push_forces=((0, 0.0, 0.0), (40, 5.0, 15.0)),
    settling=5,
    first_frames=40,
    max_frames=2_000,
    holdout=3,
    encoder_batch=8,
    unroll=6,
    streams=4,
    end_to_end_streams=2,
    publish_period=1.0,
    save_period=2.0,
    log_period=1.0,
    evaluation_period=4.0,
    evaluation_trials=1,
  )


PRESETS: Mapping[str, Callable[[], DistillSettings]] = {
  "nerf_nav": nerf_nav,
  "nerf_nav_60x80": nerf_nav_60x80,
  "ball_push": ball_push,
  "ball_push_on": ball_push_on,
  "adapt": adapt,
  "nerf_nav_on": nerf_nav_on,
  "nerf_nav_faster": nerf_nav_faster,
  "room": room,
  "tiny": tiny,
}


def preset(name: str) -> DistillSettings:
  """Returns the settings called name; raises ValueError for an unknown one."""
  if name not in PRESETS:
    raise ValueError(f"Unknown preset {name!r}: expected one of {', '.join(PRESETS)}.")
  return PRESETS[name]()
