"""A result against a truth, or against its own video."""
