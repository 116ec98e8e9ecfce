"""The robot's camera: newest picture of a device, file or stream, and lens calibration."""
