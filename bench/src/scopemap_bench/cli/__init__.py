"""Commands that this package adds to `scopemap`."""
