"""Proprioceptive sensors: filters, gravity estimate, delays and histories."""
