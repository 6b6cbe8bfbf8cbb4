"""Stamped camera poses, and the trajectory files of others."""
