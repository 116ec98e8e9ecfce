"""How hypotheses of one joint are found: sets of effects that grow, rivals, fits near the best."""
