"""Which share of the tissue was never seen, and where."""
