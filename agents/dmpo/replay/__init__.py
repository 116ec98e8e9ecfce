"""Trajectories in store: the ring, those of earlier runs, features of frozen encoders."""
