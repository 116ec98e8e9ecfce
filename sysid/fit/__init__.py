"""Fits of hypotheses to logs: least squares, intervals of the values, residual signatures."""
