"""Exit statuses of a run's processes, by which the supervisor restarts or ends them.

0 is the regular end; every other status than these is a death, after which a process is replaced.
"""

REFUSED = 2
"""The process cannot start with its arguments: another start would not help."""
NOT_SAVED = 3
"""The learner ended in order, but its last checkpoint or policy could not be written."""
