"""A task in the browser."""
