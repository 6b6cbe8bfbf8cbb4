"""A stream, as it comes."""
