"""Where a model of the pictures is wrong: by its own matches and points."""
