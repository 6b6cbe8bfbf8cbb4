"""Hamlyn: rectified stereo laparoscopy with depth by stereo matching, and the trackers' test sequences.

`rectifiedNN/image01/0000000000.jpg` (left), `depth01/0000000000.png` (uint16 mm, 0 = none); the intrinsics are in a
tree of their own, `calibration/rectifiedNN/intrinsics.txt`. `hamlyn_tracking_test_data/testN/{color,depth}` and
`intrinsics.txt`: cropped images with predicted depth. Neither has camera poses.
Recasens et al., "Endo-Depth-and-Motion", arXiv 2103.16525.
"""

from __future__ import annotations

import re
from pathlib import Path

from scopemap_bench.datasets.layouts import LayoutFolder, Place

_NO_POSE = "no pose is known: the data set has none"


class HamlynFolder(LayoutFolder):
    """The left images of a rectified sequence."""

    name = "hamlyn"
    places = (Place("image01", depths=("depth01/{}.png",)),)
    intrinsics = (("intrinsics.txt", 0), ("calibration/{}/intrinsics.txt", 3), ("intrinsics_{}.txt", 3))
    quality = "stereo"
    remarks = ("depth beside the images: stereo matching, no sensor", _NO_POSE)


class HamlynTrackingFolder(LayoutFolder):
    """A sequence of `hamlyn_tracking_test_data`: images a bit smaller than the rectified, depth by a network."""

    name = "hamlyn-tracking"
    places = (Place("color", depths=("depth/{}.png",), needs="depth"),)
    needs = (("intrinsics.txt",),)
    intrinsics = (("intrinsics.txt", 0),)
    quality = "predicted"
    remarks = ("depth beside the images: predicted by Endo-Depth, cut at 300 mm", _NO_POSE)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether `path` is of the layout, its pictures with names of 10 digits."""
        first = next(iter(cls.places[0].pictures(path)), path)
        return super().recognises(path) and re.fullmatch(r"\d{10}", first.stem) is not None
