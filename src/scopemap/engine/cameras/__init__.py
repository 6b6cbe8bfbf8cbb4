"""Cameras: pinhole and lens models, and rectification."""
