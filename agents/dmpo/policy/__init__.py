"""A policy in NumPy alone: its step, acting with it, its folder, the picture of its belief."""
