"""The robot's loop and gravity estimate on the virtual robot, and its gap to simulation."""
