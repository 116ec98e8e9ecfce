"""Pictures that came with depth and poses: poses, lens and sensor adjusted to what they show."""
