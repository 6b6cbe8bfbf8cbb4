"""The folder of a result: what a run leaves, and all that is read after it."""
