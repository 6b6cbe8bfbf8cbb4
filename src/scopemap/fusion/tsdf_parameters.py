"""How fine and how far to fuse: sizes that nobody set follow the scene, because millimetres seldom mean the same.

A laparoscope looks at a gallbladder from a hand's breadth, a colonoscope brushes the wall, and depth that a network
guesses may be off by a factor. Voxels of 1 mm suit tissue 60 mm away (Endo-Depth-and-Motion, RA-L 2021, uses them
there, with a truncation of 5 mm); the same proportions are kept at every distance.
"""

from __future__ import annotations

from typing import NamedTuple

from scopemap.config import FusionSettings

VOXELS_PER_DISTANCE = 60
_VOXELS_PER_TRUNCATION = 5
# So far away a voxel is still larger than a pixel, and a tube that narrows the view is seen for most of its length.
_VOXELS_PER_REACH = 200
# Below this no endoscope resolves anything, and memory would be spent on noise.
_LEAST_VOXEL_MM = 0.01


class Sizes(NamedTuple):
    """Edge of a voxel, how far from the surface the field is kept, and up to which depth is fused, mm."""

    voxel_mm: float
    truncation_mm: float
    max_depth_mm: float


def follows_scene(settings: FusionSettings) -> bool:
    """Whether the voxels are to be chosen when the scene is known."""
    return settings.voxel_mm is None


def choose_sizes(settings: FusionSettings, typical_mm: float | None = None) -> Sizes:
    """Return the sizes that are set, and for the others what suits tissue at a distance of `typical_mm`.

    Raises `ValueError` where `voxel_mm` is not set and the distance is not known.
    """
    voxel_mm = settings.voxel_mm
    if voxel_mm is None:
        if typical_mm is None or not typical_mm > 0:
            raise ValueError("fusing without fusion.voxel_mm: the scene's typical depth must be known")
        # Two digits: nobody needs more, and a clip cut elsewhere gives the same.
        voxel_mm = float(f"{max(typical_mm / VOXELS_PER_DISTANCE, _LEAST_VOXEL_MM):.2g}")
    return Sizes(
        voxel_mm,
        settings.truncation_mm or round(_VOXELS_PER_TRUNCATION * voxel_mm, 4),
        settings.max_depth_mm or round(_VOXELS_PER_REACH * voxel_mm, 4),
    )


def with_sizes(settings: FusionSettings, sizes: Sizes) -> FusionSettings:
    """Return the settings with the sizes that were used, as a result's settings state them."""
    return settings.model_copy(update=sizes._asdict())


def described(sizes: Sizes) -> str:
    """Say which sizes the scene was given, and how to change them."""
    return (
        f"voxels of {sizes.voxel_mm:g} mm, 1/{VOXELS_PER_DISTANCE} of the clip's median depth, and depth up to "
        f"{sizes.max_depth_mm:g} mm; set fusion.voxel_mm for others"
    )
