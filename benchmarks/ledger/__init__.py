"""The ledger: a record of every published figure, and what may stand in a README without one."""
