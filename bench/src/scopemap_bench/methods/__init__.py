"""The program's own method and the baselines, with one interface."""
