"""Learner and actor processes, with their checkpoints, logs and environments."""
