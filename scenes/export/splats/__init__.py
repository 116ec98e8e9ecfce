"""3D Gaussian splats fitted to a radiance field: start, projection, rasterisation, fit, file."""
