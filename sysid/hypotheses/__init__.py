"""Effect hypotheses: candidates, their parameters, and signatures in the residual."""
