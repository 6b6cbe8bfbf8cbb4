"""A run's folder written in the layouts of other people's tools."""
