"""Domain randomisation: an episode's draws and what they change in the compiled model."""
