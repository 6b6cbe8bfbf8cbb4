"""Sizes on the surface, and of lesions."""
