"""A camera from pictures of a board."""
