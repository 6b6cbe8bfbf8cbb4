"""A phantom, a run, an evaluation: the first minute."""
