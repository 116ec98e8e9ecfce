"""Features of keyframes, the pairs to match, their verified matches and parallax."""
