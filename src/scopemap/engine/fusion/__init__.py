"""Volumetric fusion: posed depth frames to one coloured triangle mesh."""
