"""A small empty room, and the tasks in it without anything random."""

from nerf2real import suite
from tests.suite.synthetic import FlatRenderer


def load(task, room, **options):
  """Loads a task in the room, with a renderer that sees one colour."""
  return suite.load(task, scene=room, renderer=FlatRenderer(), **options)
