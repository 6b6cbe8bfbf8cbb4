"""Trajectories, and the files in which other programs write them."""
