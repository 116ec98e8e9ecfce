"""The robot's sensors: camera, IMU path, gravity estimate, delays and histories."""
