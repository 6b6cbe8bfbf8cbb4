"""TSDF parameters: those that are not set follow the scene, since the scale of millimetres differs from clip to clip.

A laparoscope is 100 mm from the tissue, a colonoscope close to the wall, and a network's depth may be off by a factor.
Voxels of 1 mm suit tissue 60 mm away (Endo-Depth-and-Motion, RA-L 2021, truncation 5 mm); other distances keep
the proportions.
"""

from __future__ import annotations

from typing import NamedTuple

from scopemap.config import FusionSettings

VOXELS_PER_MEDIAN_DEPTH = 60
_VOXELS_PER_TRUNCATION = 5
# At this depth a voxel is still larger than a pixel, and a narrowing tube is seen for most of its length.
_VOXELS_PER_MAX_DEPTH = 200
# No endoscope resolves less; memory would be spent on noise.
_MIN_VOXEL_MM = 0.01


class TsdfParameters(NamedTuple):
    """Edge of a voxel, truncation of the distance, and largest depth that is fused, mm."""

    voxel_mm: float
    truncation_mm: float
    max_depth_mm: float

    @property
    def description(self) -> str:
        """A note on parameters that follow the scene, and how to set others."""
        return (
            f"fusion: voxels of {self.voxel_mm:g} mm, 1/{VOXELS_PER_MEDIAN_DEPTH} of the clip's median depth, and "
            f"depth up to {self.max_depth_mm:g} mm; set fusion.voxel_mm for others"
        )


def choose_parameters(settings: FusionSettings, median_depth_mm: float | None = None) -> TsdfParameters:
    """Return the parameters that are set, and for the others those that suit tissue at `median_depth_mm`.

    Raises `ValueError` where neither `voxel_mm` nor the depth is known.
    """
    voxel_mm = settings.voxel_mm
    if voxel_mm is None:
        if median_depth_mm is None or not median_depth_mm > 0:
            raise ValueError("fusing without fusion.voxel_mm: the scene's median depth must be known")
        # Two digits: a clip cut at another frame gives the same.
        voxel_mm = float(f"{max(median_depth_mm / VOXELS_PER_MEDIAN_DEPTH, _MIN_VOXEL_MM):.2g}")
    return TsdfParameters(
        voxel_mm,
        settings.truncation_mm or round(_VOXELS_PER_TRUNCATION * voxel_mm, 4),
        settings.max_depth_mm or round(_VOXELS_PER_MAX_DEPTH * voxel_mm, 4),
    )
