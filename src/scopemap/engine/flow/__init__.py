"""Optical flow of two images: estimators behind one protocol (`create.py`), forward-backward consistency, corners."""
