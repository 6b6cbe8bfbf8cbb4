"""The CLiMB challenge: submissions and their check."""
