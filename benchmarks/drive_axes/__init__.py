"""Axes under cascaded drive control: the fourth generator of blind sets."""
