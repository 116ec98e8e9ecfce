"""A scripted walker for the OP3: leg kinematics, a gait and its steering. Nothing is learned."""
