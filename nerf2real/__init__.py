"""From a phone video of a room to a vision policy that works on a robot in that room.

The packages lie at the top of the checkout; the links beside this file give them their names.
"""

__version__ = "0.1.0"
