"""Quality: figures on held-out pictures, geometry errors, the report."""
