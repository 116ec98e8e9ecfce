"""Dense stereo between posed pictures: depth wherever they show some texture."""
