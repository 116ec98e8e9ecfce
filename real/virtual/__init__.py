"""A virtual robot behind the wires of the real one: devices on a bus, a camera, a body."""
