"""Cameras: pinhole and lens models, rectification, and camera file formats."""
