"""The agent: updates, policy steps, the link, learning curves, success on two plants."""
