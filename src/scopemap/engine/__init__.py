"""The algorithm: frame to depth, pose and place in the surface; no file formats, no clock, no printing."""
