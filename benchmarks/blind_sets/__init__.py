"""Blind sets for `benchmarks/identify.py`: logs of an apparatus with effects its model lacks.

The plant is this package's own: rigid-body equations, gear train, friction, motor and firmware
share no code with `sysid`, `suite` or MuJoCo's stepping, so that naming an effect here is naming it
in something that the analyser's simulator is not. MuJoCo parses the declared models, and rolls them
out only to measure how far a machine is from its model.
"""
