"""Numbers only: depth, surfaces, consistency, the protocols of other papers."""
