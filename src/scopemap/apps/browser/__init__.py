"""The window in the browser: choose a video, watch the run, look at its result, compare two."""
