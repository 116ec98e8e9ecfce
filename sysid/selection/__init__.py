"""Model selection: from fitted hypotheses to a verdict."""
