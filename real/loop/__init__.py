"""The control loop: the environment, the bus cycle, slow moves, clocks and timing."""
