"""The paper's evaluation on any plant: simulation, virtual robot, robot. See `launch/evaluate.py`.

`plants` sets a trial up and steps it, `runner` runs and classifies it, `episodes` keeps what
happened so that a run that was cut short goes on, `tables` and `report` show it.
"""
