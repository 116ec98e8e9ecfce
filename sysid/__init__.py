"""Measured logs: residual, missing effect, extended model, report."""
