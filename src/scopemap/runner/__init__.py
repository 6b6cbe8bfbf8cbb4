"""Runs: a sequence from its first frame to the last, or frames one at a time."""
