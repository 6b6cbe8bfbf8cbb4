"""Folder or file on disk -> sequence of (Frame, Truth or None)."""

from scopemap.datasets.frame_choice import SkippedFrame
from scopemap.datasets.opening import DATASETS, open_sequence, open_source
from scopemap.datasets.sequence import Sequence, Source, SourceFrame, SourceTruth

__all__ = [
    "DATASETS",
    "Sequence",
    "SkippedFrame",
    "Source",
    "SourceFrame",
    "SourceTruth",
    "open_sequence",
    "open_source",
]
