"""Input: videos, image folders, data sets, decoding, and network weights."""
