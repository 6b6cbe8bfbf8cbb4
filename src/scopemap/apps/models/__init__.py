"""The networks' weights on this machine."""
