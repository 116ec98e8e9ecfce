"""Agents: DMPO, and the link between its actors and its learner."""
