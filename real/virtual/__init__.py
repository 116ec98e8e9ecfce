"""A virtual robot and the room it stands in, whose truth is known."""
