"""The robot's camera: newest picture, the policy's picture, lens calibration."""
