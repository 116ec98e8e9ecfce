"""The loop from a robot to the suite and back: excite, record, identify, simulate, compare."""
