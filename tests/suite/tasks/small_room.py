"""A small empty room, and the tasks in it without anything random."""

from nerf2real import suite
from nerf2real.suite.randomisation.draws import RandomisationSettings
from tests.suite.synthetic import FlatRenderer

NOMINAL = RandomisationSettings(
  pushes=False,
  delays=False,
  jitter=False,
  torso_mass=False,
  imu_pose=False,
  ball_mass=False,
  ball_radius=False,
)


def load(task, room, **options):
  """Loads a task in the room, with a renderer that sees one colour."""
  return suite.load(task, scene=room, renderer=FlatRenderer(), **options)
