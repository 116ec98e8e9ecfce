"""Geometry: depth fusion, surface mesh, contact geometry, free floor."""
