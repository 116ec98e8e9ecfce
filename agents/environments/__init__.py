"""Environments by name: the suite's tasks, dm_control's, and a small memory task."""
