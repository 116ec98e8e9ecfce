"""A second generator of blind sets; it shares the format with `benchmarks/blind_sets`, and no code.

Machines, equations of motion, motors, friction, excitation, sensors and integration are this
package's own; MuJoCo only rolls out declared models, to say how far a machine is from its model.
"""
