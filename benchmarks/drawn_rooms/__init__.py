"""Other rooms than the built-in one, drawn anew for every seed, filmed and known exactly."""
