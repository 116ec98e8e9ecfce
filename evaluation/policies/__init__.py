"""Policies in an evaluation: the scripted walker, exported networks, falsified observations."""
