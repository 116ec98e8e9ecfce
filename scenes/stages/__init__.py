"""The stages of a job from a capture to a scene: cached functions of earlier results."""
