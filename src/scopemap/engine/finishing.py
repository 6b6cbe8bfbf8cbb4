"""The steps by which the frames of a segment become a surface; `Pipeline.surface` says in which order."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import FusionSettings
from scopemap.engine.depth.under_highlights import depth_under_highlights
from scopemap.engine.estimators import Estimators
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import rendered_frames, surface_agreement, vertex_sigmas
from scopemap.engine.fusion.finish import finished, with_normals_alone
from scopemap.engine.fusion.frame_selection import FrameSelector
from scopemap.engine.fusion.frame_store import SpreadFrames
from scopemap.engine.fusion.free_space import FreeSpace, reference_frames
from scopemap.engine.fusion.moving_tissue import MovingTissue, block_edge_mm
from scopemap.engine.fusion.surface_fusion import FusedSurface, SurfaceFusion, depth_notices
from scopemap.engine.mapping.correction import FinalFrames
from scopemap.engine.mapping.multiview_depth import KeyframeDepths
from scopemap.engine.mapping.segments import Segment, Submap
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.track import TrackedFrames


class Execution:
    """How the steps after the last frame are carried out: here one after the other, in the thread of the caller.

    keeps_depth : whether the final depth of frames is kept, and not only fused.
    """

    keeps_depth = True

    def timed(self, part: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a call returns, which is a part of the run."""
        return call(*arguments)

    def in_thread(self, frames: Iterator[Frame], thread: str) -> Generator[Frame, None, None]:
        """Yield frames in order; a thread of this name may compute them."""
        yield from frames

    def final(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """Yield frames whose pose and depth are final; they may be written."""
        return frames


@dataclass(frozen=True)
class SegmentSurface:
    """The surface of a segment.

    mesh : world mm, may be empty; its vertices have `confidence`, the share `moving` of frames in which they move, and
    the standard deviation `sigma_mm`. settings : with the TSDF parameters that were used. agreement : figures of
    `surface_agreement`. is_checked : whether depth was measured, or an adjustment was tried: notices say what it found.
    """

    mesh: trimesh.Trimesh
    settings: FusionSettings
    agreement: dict[str, float]
    is_checked: bool
    notices: list[Notice]


class SegmentFinishing:
    """Finishes a segment of a submap: each step once, and `close` after `fuse`.

    fusion : stores, or has fused, the frames. tracked : all frames of the run. checked : frames at which a surface that
    was fused at once is checked; those of stored frames are added.
    """

    def __init__(
        self,
        fusion: SurfaceFusion,
        estimators: Estimators,
        submap: Submap,
        segment: Segment,
        tracked: TrackedFrames,
        checked: SpreadFrames | None = None,
    ) -> None:
        self._fusion, self._estimators, self._submap, self._tracked = fusion, estimators, submap, tracked
        self._checked = SpreadFrames() if checked is None else checked
        poses = tracked.poses_of(segment.frames) if fusion.at_end else {}
        self._final = FinalFrames(segment.correction, poses, fusion.store.frame)
        # Of the frames that the largest depth was chosen from, so that it cannot contradict itself.
        main = submap.main_frames if fusion.at_end else ()
        self._median_mm = fusion.store.median_depth_mm(main, submap.depth_factor)
        self._moving = MovingTissue(block_edge_mm(self._median_mm))
        self._free_space = FreeSpace([])
        self._depths: KeyframeDepths | None = None

    def triangulate(self, camera: PinholeCamera) -> None:
        """Have the depth of keyframes triangulated, which the other frames take over, where a flow matches them."""
        final, flow = self._final, self._estimators.keyframe_flow
        if final.keyframes and flow.name != "none":
            self._depths = KeyframeDepths(final.view, final.T_world_camera, final.keyframes, camera, flow)

    def find_free_space(self) -> None:
        """Find what frames look through; the pixels that show it are left out."""
        if self._fusion.settings.free_space:
            some = reference_frames(list(self._final.T_world_camera))
            self._free_space = FreeSpace(self._final.frames(None, among=some))

    def corrected(self) -> Iterator[Frame]:
        """Yield the final frames, those that were stored: pose and depth corrected, triangulated, carved.

        Under highlights depth is that of what is around them, unless it was measured.
        """
        triangulated = None if self._depths is None else self._depths.depth
        is_measured = self._estimators.anchor.is_measured
        for frame in self._final.frames(triangulated, self._free_space.without):
            depth_mm = np.asarray(frame.depth_mm)
            yield frame if is_measured else replace(frame, depth_mm=depth_under_highlights(depth_mm, frame.highlights))

    def chosen(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the final frames that show tissue anew; note where tissue moves in all, and some for `check`."""
        selector = FrameSelector(self._fusion.settings.every)
        for frame in frames:
            if frame.nonrigidity is not None and frame.T_world_camera is not None:
                usable_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
                self._moving.put(usable_mm, frame.nonrigidity, frame.camera, frame.T_world_camera)
            self._checked.put(frame)
            if (chosen := selector.chosen(frame)) is not None:
                yield chosen

    def fuse(self, frames: Iterable[Frame]) -> FusedSurface:
        """Return the surface of the frames that `chosen` yields, or of those that were fused at once."""
        return self._fusion.fuse(frames, self._median_mm, self._submap.main)

    def close(self) -> None:
        """Stop the thread of the triangulation."""
        if self._depths is not None:
            self._depths.close()

    def finish(self, fused: FusedSurface) -> FusedSurface:
        """Return the surface with a finished mesh, whose vertices have the share of frames in which they move."""
        mesh = finished(fused.mesh, fused.settings)
        mesh.vertex_attributes["moving"] = self._moving.shares(mesh.vertices).astype(np.float32)
        return replace(fused, mesh=mesh)

    def check(self, fused: FusedSurface, adjusted: list[Notice]) -> SegmentSurface:
        """Return the finished surface with its agreement with some frames, and what there is to say about it.

        adjusted : what is known of the adjustment of its keyframes, kept or refused; [] where none was tried.
        """
        mesh = fused.mesh
        rendered = rendered_frames(mesh, self._checked.frames(self._fusion.store))
        agreement = surface_agreement(rendered, fused.settings)
        mesh.vertex_attributes["sigma_mm"] = vertex_sigmas(len(mesh.vertices), rendered)
        is_checked = bool(adjusted) or self._estimators.anchor.is_measured
        notices = adjusted + self._fusion_notices(fused)
        return SegmentSurface(with_normals_alone(mesh), fused.settings, agreement, is_checked, notices)

    def _fusion_notices(self, fused: FusedSurface) -> list[Notice]:
        """Return what depth and surface rest on, and what is not in the surface."""
        found = [] if self._depths is None else [self._depths.notice]
        found += fused.notices
        if self._free_space.notice is not None:
            found.append(self._free_space.notice)
        if (masks := self._estimators.masks) is not None:
            found += masks.notices
        known_mm = self._tracked.median_depth_mm[np.isfinite(self._tracked.median_depth_mm)]
        medians_mm = known_mm.tolist() if self._median_mm is None else [self._median_mm]
        return found + depth_notices(medians_mm, fused.settings)
