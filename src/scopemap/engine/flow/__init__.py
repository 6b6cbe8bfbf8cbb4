"""Optical flow: estimators behind one protocol (`estimator.py`), forward-backward consistency, corners."""
