"""The two tasks of the paper."""
