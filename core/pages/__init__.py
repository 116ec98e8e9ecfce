"""HTML pages: one kit for every report."""
