"""Finds matching pairs of pictures that contradict the rotations which most of the others agree on.

Two windows with one view, or two shelves of like books, match as well as one thing seen twice. Seen
as one they turn the pictures' frames against each other: around a loop of pairs with such a one
rotations do not come to nothing. So rotations are looked for that agree with the pairs of the
largest matched area; what does not agree is taken for things alike. Positions play no part, and no
mapper, which may begin with the wrong pair and build on it.

Sources: Zach et al. 2010, Disambiguating Visual Relations Using Loop Constraints; Govindu 2006,
Robustness in Motion Averaging (consensus over random spanning trees). Shapes: N pictures, E pairs.
"""

import heapq
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.checks.agreement import cells_of

_FEWEST = 15  # matches of a pair that says something, as many as a place needs
_CERTAIN = 4.0  # pixels within which matches agree with a relative pose
_AGREES = np.radians(
  6.0
)  # of a pair's rotation with its pictures', chosen: a pair's own error is 1
_CONTRADICTS = np.radians(15.0)  # beyond which it is of other things, chosen
_TREES = 100  # at most
_AGAIN = 5  # trees that lead to the same: enough
_SWEEPS = 6  # over all pictures after a tree


class Pairs(NamedTuple):
  """Relative rotations of matching pairs."""

  ids: list[int]  # of the pictures [N]
  first: np.ndarray  # rows of the pairs' pictures [E]
  second: np.ndarray  # [E]
  rotations: np.ndarray  # second from first, camera axes [E, 3, 3]
  areas: np.ndarray  # cells that matches cover, of the picture where they cover fewer [E]


def angles(rotations: np.ndarray) -> np.ndarray:
  """Angles of rotations [..., 3, 3] [rad]."""
  cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2
  found: np.ndarray = np.arccos(np.clip(cosine, -1, 1))
  return found


def relative_rotations(database: Path, camera: pycolmap.Camera, *, seed: int = 0) -> Pairs:
  """Reads verified matches and finds each pair's relative rotation by its essential matrix.

  Args:
    database: Features and verified matches.
    camera: The one camera of all pictures, as a model has it.
    seed: Of RANSAC.
  """
  cv2.setRNGSeed(seed)
  with pycolmap.Database.open(str(database)) as db:
    numbers, verified = db.read_two_view_geometries()
    ids = sorted(image.image_id for image in db.read_all_images())
    features = {key: db.read_keypoints(key)[:, :2].astype(float) for key in ids}
  row = {key: number for number, key in enumerate(ids)}
  found = []
  for number, geometry in zip(numbers, verified, strict=True):
    pair, matches = pycolmap.pair_id_to_image_pair(number), geometry.inlier_matches
    if len(matches) < _FEWEST:
      continue
    pixels = [features[key][matches[:, side]] for side, key in enumerate(pair)]
    rays, others = (camera.cam_from_img(seen) for seen in pixels)
    within = _CERTAIN / camera.focal_length_x
    essential, inside = cv2.findEssentialMat(
      rays, others, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=within
    )
    if essential is None or essential.shape != (3, 3):
      continue
    count, rotation, _, _ = cv2.recoverPose(essential, rays, others, np.eye(3), mask=inside)
    if count >= _FEWEST:
      area = min(len(np.unique(cells_of(camera, seen))) for seen in pixels)
      found.append((row[pair[0]], row[pair[1]], rotation, area))
  first, second, turns, areas = zip(*found, strict=True) if found else ((), (), (), ())
  return Pairs(
    ids,
    np.array(first, int),
    np.array(second, int),
    np.array(turns, float).reshape(-1, 3, 3),
    np.array(areas, float),
  )


def errors(pairs: Pairs, cam_from_world: np.ndarray) -> np.ndarray:
  """How far pairs' rotations are off those of their pictures [N, 3, 3]: [E] [rad]."""
  begun = pairs.rotations @ cam_from_world[pairs.first]
  return angles(np.swapaxes(begun, -1, -2) @ cam_from_world[pairs.second])


def consensus(pairs: Pairs, *, seed: int = 0) -> np.ndarray:
  """Rotations of all pictures with which pairs of the largest area agree: camera from world.

  A spanning tree of random pairs, large ones rather, gives the first rotations; then each picture
  takes that of its pairs' which agrees with most area, until none changes.

  Args:
    pairs: Relative rotations.
    seed: Of the trees.

  Returns:
    [N, 3, 3]; the identity of pictures that no pair joins to the others.
  """
  random = np.random.default_rng(seed)
  joined: list[list[int]] = [[] for _ in pairs.ids]
  for number, ends in enumerate(zip(pairs.first, pairs.second, strict=True)):
    for end in ends:
      joined[end].append(number)
  best, found, times = -1.0, np.tile(np.eye(3), (len(pairs.ids), 1, 1)), 0
  for tree in range(_TREES if len(pairs.areas) else 0):
    keys = pairs.areas * (random.exponential(size=len(pairs.areas)) if tree else 1.0)
    rotations = _settled(pairs, joined, _along_tree(pairs, joined, keys), random)
    area = float(pairs.areas[errors(pairs, rotations) < _AGREES].sum())
    times = times + 1 if area == best else 1 if area > best else times
    if area > best:
      best, found = area, rotations
    if times >= _AGAIN:
      break
  return found


def _seen_from(pairs: Pairs, number: int, picture: int, rotations: np.ndarray) -> np.ndarray:
  """The rotation of a picture by one of its pairs and the other's rotation."""
  relative = pairs.rotations[number]
  if pairs.second[number] == picture:
    return relative @ rotations[pairs.first[number]]
  return relative.T @ rotations[pairs.second[number]]


def _along_tree(pairs: Pairs, joined: list[list[int]], keys: np.ndarray) -> np.ndarray:
  """Rotations along the pairs of the largest keys that join all pictures to one."""
  rotations = np.tile(np.eye(3), (len(joined), 1, 1))
  begin = int(pairs.first[np.argmax(keys)])
  done, waiting = {begin}, [(-keys[number], number) for number in joined[begin]]
  heapq.heapify(waiting)
  while waiting:
    number = heapq.heappop(waiting)[1]
    for end in (int(pairs.first[number]), int(pairs.second[number])):
      if end not in done:
        rotations[end] = _seen_from(pairs, number, end, rotations)
        done.add(end)
        for more in joined[end]:
          heapq.heappush(waiting, (-keys[more], more))
  return rotations


def _settled(
  pairs: Pairs, joined: list[list[int]], rotations: np.ndarray, random: np.random.Generator
) -> np.ndarray:
  """Lets each picture take that of its pairs' rotations which most of their area agrees with."""
  for _ in range(_SWEEPS):
    changed = False
    for picture in random.permutation(len(joined)):
      numbers = joined[picture]
      if not numbers:
        continue
      offered = np.array([_seen_from(pairs, n, picture, rotations) for n in numbers])
      asked = np.concatenate([offered, rotations[picture][None]])
      turned = np.einsum("aij,bij->ab", asked, offered)  # traces
      near = (turned - 1) / 2 > np.cos(_AGREES)
      area = near @ pairs.areas[numbers]
      if area[:-1].max() > area[-1]:
        rotations[picture] = offered[int(np.argmax(area[:-1]))]
        changed = True
    if not changed:
      break
  return rotations


class Contradiction(NamedTuple):
  """What a consensus of rotations says against a model."""

  turned: list[str]  # names of the pictures that stand otherwise in the model
  refuted: set[tuple[int, int]]  # pairs, by ids, whose rotations contradict the consensus


def contradiction(
  model: pycolmap.Reconstruction, pairs: Pairs, rotations: np.ndarray
) -> Contradiction | None:
  """Compares a model with the rotations that its pairs agree on.

  Args:
    model: Poses.
    pairs: Relative rotations.
    rotations: Their consensus [N, 3, 3].

  Returns:
    None where all pictures stand as in the consensus, or pairs of as much area agree with the
    model: where parts hang together by little a consensus may turn one.
  """
  images = mapping.registered(model)
  rows = [pairs.ids.index(image.image_id) for image in images]
  own = rotations.copy()
  own[rows] = [image.cam_from_world().rotation.matrix() for image in images]
  placed = np.isin(pairs.first, rows) & np.isin(pairs.second, rows)
  contradicts = errors(pairs, rotations) > _CONTRADICTS
  agreeing = pairs.areas[placed & (errors(pairs, own) <= _CONTRADICTS)].sum()
  if agreeing >= pairs.areas[placed & ~contradicts].sum():
    return None
  frames = np.swapaxes(rotations, -1, -2)[rows] @ own[rows]  # the same but for turned pictures
  apart = angles(np.swapaxes(frames, -1, -2)[:, None] @ frames[None])
  off = apart[int(np.argmax((apart < _AGREES).sum(1)))] > _CONTRADICTS
  if not off.any():
    return None
  ends = zip(pairs.first[contradicts], pairs.second[contradicts], strict=True)
  return Contradiction(
    [image.name for image, turned in zip(images, off, strict=True) if turned],
    {(pairs.ids[one], pairs.ids[other]) for one, other in ends},
  )
