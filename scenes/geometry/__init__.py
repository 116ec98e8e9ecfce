"""Geometry: depth fusion, surface mesh, world frame, contact geometry, free floor."""
