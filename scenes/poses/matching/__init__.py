"""Features of keyframes, the pairs to match, their verified and guided matches, and parallax."""
