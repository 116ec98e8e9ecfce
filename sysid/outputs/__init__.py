"""The files that an identification writes."""
