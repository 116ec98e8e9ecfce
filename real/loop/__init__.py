"""The control loop: the environment, the bus cycle, sensing, pictures, slow moves, timing."""
