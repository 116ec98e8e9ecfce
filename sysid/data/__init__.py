"""Measured logs of one joint: checks before anything is fitted, and what is measured."""
