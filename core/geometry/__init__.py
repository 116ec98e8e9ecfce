"""Where things are: rotations, similarities, cameras."""
