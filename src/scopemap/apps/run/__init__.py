"""One video to a result."""
