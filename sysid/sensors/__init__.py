"""Sensors beside the joints: IMU, camera, floor."""
