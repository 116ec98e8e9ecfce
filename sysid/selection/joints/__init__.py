"""One joint: what is known beforehand, what is named, what remains, the verdict."""
