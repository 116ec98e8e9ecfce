"""The robot's wire: serial port, bus, servos, IMU board."""
