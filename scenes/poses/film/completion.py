"""Places what a film's map lacks, once the rest of it is held by a hand's motion.

Pictures between two parts that a mapper has placed at different sizes contradict both: they leap,
and the film's line leaves them out, or the mapper itself. In the held map the parts have one size,
and there is a place between them.
"""

from collections.abc import Mapping
from pathlib import Path

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.film import continuity, motion_prior


def complete(
  held: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  times: Mapping[str, float],
  *,
  seed: int,
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, frozenset[str]]:
  """Returns a held map with what can be placed beside it, and pictures that are out of its line.

  Args:
    held: What `motion_prior.hold` has made of a film's map.
    database: Its features and verified matches.
    images_folder: Where the pictures lie.
    times: When each picture was taken [s].
    seed: Of the random choices.
    report: Called with the fraction done and a text.

  Returns:
    A map of at least as many pictures, the same object where there is no other, and the names of
    those that lost their place in it.
  """
  found, moved = agreement.place_again(held, database, images_folder, seed=seed, report=report)
  if not moved:
    return held, frozenset()
  found = motion_prior.hold(found, database, times, rounds=motion_prior.AS_IT_IS, report=report)
  lost = continuity.drop_out_of_line(found, database, times)
  if found.num_reg_images() < held.num_reg_images():
    return held, frozenset()
  return found, lost.names
