"""The simulated world: environment steps, effects, the physics step, the scripted walker."""
