"""Checks of measured logs before anything is fitted."""
