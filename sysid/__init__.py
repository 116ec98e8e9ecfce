"""Measured logs: residual, missing effect, extended model, report."""

from sysid.identification import Settings
from sysid.outputs import evaluate, identify

__all__ = ["Settings", "evaluate", "identify"]
