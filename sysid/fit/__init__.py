"""Fits of hypotheses to logs, and the intervals of their values."""
