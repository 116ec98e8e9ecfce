"""Pictures of the simulated world: the robot's camera, a map, a spectator's view."""
