"""The collectors' side of a distillation: labelled episodes, and trials of the student alone."""
