"""Mathematics only: rigid motion, warping, alignment."""
