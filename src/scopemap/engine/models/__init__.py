"""Weights of networks, and the device they run on."""
