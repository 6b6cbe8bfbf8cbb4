"""Applications: each folder is one, with its command."""
