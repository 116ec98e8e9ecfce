"""The robot of a loop: what it is made to do, and what its logs hold of it."""
