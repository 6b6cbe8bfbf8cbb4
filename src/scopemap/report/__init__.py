"""Pictures and reports of a run; numbers come from `evaluation`."""
