"""Whether a solver keeps the contract, and where it is weak."""
