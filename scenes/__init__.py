"""From a video of a room to a scene bundle: radiance field, contact geometry, metric frame."""
