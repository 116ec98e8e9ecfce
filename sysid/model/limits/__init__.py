"""What of a declared model the simulation of one joint holds, and what it leaves out."""
