"""Supervised runs: processes started, replaced and ended in order, on one machine or under Ray."""
