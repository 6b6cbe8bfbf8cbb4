"""Depth of one image: estimators behind one protocol (`estimate.py`), metric anchor, consistency over time (MAPIS)."""
