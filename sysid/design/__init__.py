"""Experiment design: what to record next."""
