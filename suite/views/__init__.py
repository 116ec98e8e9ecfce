"""Views for people: a map from above, and a spectator's view in the radiance field."""
