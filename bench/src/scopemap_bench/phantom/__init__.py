"""Synthetic endoscopy with exact truth: scenes, camera paths, rendering, and folders in the C3VD layout."""
