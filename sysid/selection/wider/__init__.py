"""Effects of bodies and of the whole machine, with evidence summed over joints."""
