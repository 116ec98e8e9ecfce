"""The recorder: MCAP logs of what the robot did and saw, and a page that shows one."""
