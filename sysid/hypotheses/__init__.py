"""Effect hypotheses: the candidates that logs can show, and their parameters."""
