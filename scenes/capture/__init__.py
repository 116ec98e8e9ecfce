"""Captures: a video, pictures or a posed data set becomes a folder of sharp keyframes."""
