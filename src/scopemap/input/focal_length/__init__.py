"""Focal length of an unknown camera, by bundle adjustment of short windows of frames."""
