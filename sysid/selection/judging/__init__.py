"""How hypotheses are compared: evidence of blocks, names that stand, what remains."""
