"""Joints as hobbyists and research robots have them: the fifth generator of blind sets."""
