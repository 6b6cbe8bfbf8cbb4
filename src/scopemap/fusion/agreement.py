"""How well a fused mesh agrees with frames, without any truth: the mesh is rendered again at their poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from skimage.metrics import structural_similarity

from scopemap.frame import Frame
from scopemap.geometry.rendering import Rendering, render_mesh


@dataclass(frozen=True)
class FrameAgreement:
    """Agreement of a mesh with one frame.

    Attributes
    ----------
    index : number of the frame. coverage : share, 0..1, of the usable pixels with known depth where the mesh is seen.
    depth_error : median of |ln(depth of the mesh / depth of the frame)| where both are known; NaN where nowhere.
    ssim : mean structural similarity of grey values over all usable pixels with known depth; holes are black.
    """

    index: int
    coverage: float
    depth_error: float
    ssim: float


def compare_with_frame(mesh: trimesh.Trimesh, frame: Frame) -> tuple[FrameAgreement, Rendering]:
    """Return the agreement of a mesh, world mm, vertex colours, with a frame of known depth and pose, and the view.

    Raises `ValueError` for a frame without depth or pose.
    """
    if frame.depth_mm is None or frame.T_world_camera is None:
        raise ValueError(f"comparing a mesh with frame {frame.index}: it has no depth or no pose")
    rendering = render_mesh(mesh, frame.camera, frame.T_world_camera)
    known = frame.valid & (frame.depth_mm > 0)
    seen = known & np.isfinite(rendering.depth_mm)
    error = np.abs(np.log(rendering.depth_mm[seen] / frame.depth_mm[seen]))
    grey, shown = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (frame.rgb, rendering.rgb))
    _, similarity = structural_similarity(grey, shown, full=True)
    agreement = FrameAgreement(
        frame.index,
        float(seen.sum() / max(known.sum(), 1)),
        float(np.median(error)) if error.size else float("nan"),
        float(similarity[known].mean()) if known.any() else float("nan"),
    )
    return agreement, rendering


def agreement_figures(agreements: Iterable[FrameAgreement]) -> dict[str, float]:
    """Return the number of frames, mean and least coverage, median depth error and mean SSIM; NaN of no frame."""
    rows = [(a.coverage, a.depth_error, a.ssim) for a in agreements]
    coverage, depth_error, ssim = np.array(rows or [(np.nan, np.nan, np.nan)]).T
    return {
        "frames": len(rows),
        "coverage_mean": float(coverage.mean()),
        "coverage_least": float(coverage.min()),
        "depth_error": float(np.nanmedian(depth_error)) if np.isfinite(depth_error).any() else float("nan"),
        "ssim": float(ssim.mean()),
    }
