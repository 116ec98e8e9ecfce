"""Kinds of effect by where they act, and their laws."""
