"""Teachers and students: DAgger from a policy with privileged state into the agent's networks."""
