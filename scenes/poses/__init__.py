"""Camera poses: structure from motion turns keyframes into one camera, poses and points."""
