"""The built-in room: a furnished room with ground truth, to measure reconstructions with."""
