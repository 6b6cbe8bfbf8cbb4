"""Depth of one image: estimators behind one protocol (`create.py`), metric anchor, consistency over time (MAPIS)."""
