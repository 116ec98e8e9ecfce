"""The real robot behind the same specification as the simulation, and a virtual one to rehearse with."""
