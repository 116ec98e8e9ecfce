"""The real robot behind the specification of the simulation, and a virtual one for rehearsals."""
