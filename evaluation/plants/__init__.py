"""Where episodes are run: the simulation, the virtual robot, a robot; and what disturbs there."""
