"""Safety: limits, reasons to switch the torque off, the operator's stop key."""
