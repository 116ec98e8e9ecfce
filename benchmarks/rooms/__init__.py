"""Scenes: training and drawing of the field, exported splats, localisation."""
