"""The radiance field: its definition, training data, losses and training."""
