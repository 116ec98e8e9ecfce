"""What can go wrong with a robot's wires and servos, to be put into the virtual one at any time."""

import dataclasses

import numpy as np


@dataclasses.dataclass
class Faults:
  """The faults that act now; change them while the robot runs."""

  loss: float = 0.0
  """Probability that a packet, instruction or answer, does not arrive."""
  corruption: float = 0.0
  """Probability that one bit of a packet arrives flipped."""
  late: float = 0.0
  """Probability that an answer comes late."""
  lateness: float = 0.010
  """s, how late."""
  cut: bool = False
  """The cable is out: nothing arrives in either direction."""
  dead: set[int] = dataclasses.field(default_factory=set)
  """Ids that do not answer and do not move."""
  stuck: set[int] = dataclasses.field(default_factory=set)
  """Ids whose encoder keeps its value."""
  heat: dict[int, float] = dataclasses.field(default_factory=dict)
  """Id: temperature [degrees C]."""
  voltage: float | None = None
  """V of the supply whatever the load; None: the battery's."""

  def arrives(self, rng: np.random.Generator) -> bool:
    """Draws whether a packet arrives."""
    return not self.cut and not (self.loss > 0 and rng.random() < self.loss)

  def damage(self, data: bytes, rng: np.random.Generator) -> bytes:
    """Returns the bytes of a packet, perhaps with one bit flipped."""
    if self.corruption > 0 and rng.random() < self.corruption:
      found = bytearray(data)
      found[rng.integers(len(found))] ^= 1 << int(rng.integers(8))
      return bytes(found)
    return data

  def delay(self, rng: np.random.Generator) -> float:
    """Draws by how much an answer is late [s]."""
    return self.lateness if self.late > 0 and rng.random() < self.late else 0.0
