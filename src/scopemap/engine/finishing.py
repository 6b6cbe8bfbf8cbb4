"""After the last frame: the frames of each segment become a surface. Files, clock and threads: see `runner/run.py`.

    carve       find what other frames look through: it is no tissue
    frames      correct poses and depth -> triangulate the depth of keyframes, which the others take over -> carve
    as_fused    choose the frames that show tissue anew
    fuse        TSDF -> mesh
    finish      close holes, smooth, simplify
    check       render the mesh at the poses of some frames, and compare

The submaps, with their segments and the correction of each, come from `Mapper.submaps`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import FusionSettings
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import surface_agreement, surface_views, vertex_sigmas
from scopemap.engine.fusion.finish import finished, with_normals_alone
from scopemap.engine.fusion.frame_store import SpreadFrames
from scopemap.engine.fusion.free_space import FreeSpace, views_among
from scopemap.engine.fusion.moving_tissue import MovingTissue, block_edge_mm
from scopemap.engine.fusion.new_views import NewViews
from scopemap.engine.fusion.surface_fusion import FusedSurface, depth_notices
from scopemap.engine.mapping.correction import FinalFrames
from scopemap.engine.mapping.multiview_depth import KeyframeDepths
from scopemap.engine.mapping.segments import Segment, Submap
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline


@dataclass(frozen=True)
class TrackedFrames:
    """All frames of a run as tracked, in order.

    index : (F,) int, their numbers. time_s : (F,). T_world_camera : (F, 4, 4), NaN where a frame is lost.
    median_depth_mm : (F,), NaN where unknown.
    """

    index: np.ndarray
    time_s: np.ndarray
    T_world_camera: np.ndarray
    median_depth_mm: np.ndarray

    def of(self, segment: Segment) -> TrackedFrames:
        """Return the frames of a segment."""
        own = np.isin(self.index, list(segment.frames))
        return TrackedFrames(self.index[own], self.time_s[own], self.T_world_camera[own], self.median_depth_mm[own])

    @property
    def poses(self) -> dict[int, np.ndarray]:
        """The poses (4, 4) by number."""
        return dict(zip(self.index.tolist(), self.T_world_camera, strict=True))


@dataclass(frozen=True)
class SegmentSurface:
    """The surface of a segment.

    mesh : world mm, may be empty; its vertices have `confidence`, the share `moving` of frames in which they move, and
    the standard deviation `sigma_mm`. settings : with the TSDF parameters that were used. agreement : figures of
    `surface_agreement`. is_confirmed : whether depth was measured or keyframes were adjusted.
    """

    mesh: trimesh.Trimesh
    settings: FusionSettings
    agreement: dict[str, float]
    is_confirmed: bool
    notices: list[Notice]


class SegmentFinishing:
    """Finishes a segment of a submap; the methods are called in the order above, each once, and `close` after `fuse`.

    tracked : all frames of the run. camera : of all frames. keeps_depth : whether final depth is kept, and not only
    fused. checked : frames at which a surface that was fused at once is checked; those of stored frames are added.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        submap: Submap,
        segment: Segment,
        tracked: TrackedFrames,
        camera: PinholeCamera,
        *,
        keeps_depth: bool = True,
        checked: SpreadFrames | None = None,
    ) -> None:
        self._pipeline, self._fusion, self._submap = pipeline, pipeline.fusion, submap
        self._correction = segment.correction
        self._run, self._checked = tracked, SpreadFrames() if checked is None else checked
        own, at_end = tracked.of(segment), self._fusion.at_end
        self._final = FinalFrames(segment.correction, own.poses if at_end else {}, self._fusion.store.frame)
        # Of the frames that the largest depth was chosen from, so that it cannot contradict itself.
        main = submap.main_frames if at_end else ()
        self._median_mm = self._fusion.store.median_depth_mm(main, submap.depth_factor)
        self._moving = MovingTissue(block_edge_mm(self._median_mm))
        self._free_space = FreeSpace([])
        self._depths = self._triangulation(camera) if keeps_depth or self._fusion.settings.enabled else None

    def carve(self) -> None:
        """Find what frames look through; the pixels that show it are left out."""
        if self._fusion.settings.free_space:
            some = views_among(list(self._final.T_world_camera))
            self._free_space = FreeSpace(self._final.frames(None, among=some))

    def frames(self) -> Iterator[Frame]:
        """Yield the final frames, those that were stored: pose and depth corrected, carved."""
        triangulated = None if self._depths is None else self._depths.depth
        return self._final.frames(triangulated, self._free_space.without)

    def as_fused(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield final frames that are fused; note where tissue moves in all, and some for `check`."""
        views = NewViews(self._fusion.settings.every)
        for frame in frames:
            if frame.nonrigidity is not None and frame.T_world_camera is not None:
                usable_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
                self._moving.put(usable_mm, frame.nonrigidity, frame.camera, frame.T_world_camera)
            self._checked.put(frame)
            if (chosen := views.chosen(frame)) is not None:
                yield chosen

    def fuse(self, frames: Iterable[Frame]) -> FusedSurface:
        """Return the surface of the frames that `as_fused` yields, or of those that were fused at once."""
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

    def check(self, fused: FusedSurface) -> SegmentSurface:
        """Return the finished surface with its agreement with some frames, and what there is to say about it."""
        mesh = fused.mesh
        views = surface_views(mesh, self._checked.frames(self._fusion.store))
        agreement = surface_agreement(views, fused.settings)
        mesh.vertex_attributes["sigma_mm"] = vertex_sigmas(len(mesh.vertices), views)
        adjusted = self._adjustment_notices()
        confirmed = bool(adjusted) or self._pipeline.estimators.anchor.is_measured
        notices = adjusted + self._fusion_notices(fused)
        return SegmentSurface(with_normals_alone(mesh), fused.settings, agreement, confirmed, notices)

    def _triangulation(self, camera: PinholeCamera) -> KeyframeDepths | None:
        """Return what triangulates the depth of keyframes; None where nothing can."""
        final, flow = self._final, self._pipeline.estimators.keyframe_flow
        wanted = self._pipeline.config.mapping.triangulate_depth
        if not (wanted and final.keyframes) or flow.name == "none":
            return None
        return KeyframeDepths(final.view, final.T_world_camera, final.keyframes, camera, flow)

    def _adjustment_notices(self) -> list[Notice]:
        """Return what was adjusted: at the end, or as keyframes came."""
        correction = self._correction
        return self._pipeline.odometry.notices(self._submap.main) if correction is None else correction.notices

    def _fusion_notices(self, fused: FusedSurface) -> list[Notice]:
        """Return what depth and surface rest on, and what is not in the surface."""
        found = [] if self._depths is None else [self._depths.notice]
        found += fused.notices
        if self._free_space.notice is not None:
            found.append(self._free_space.notice)
        if (masks := self._pipeline.estimators.masks) is not None:
            found += masks.notices
        known_mm = self._run.median_depth_mm[np.isfinite(self._run.median_depth_mm)]
        medians_mm = known_mm.tolist() if self._median_mm is None else [self._median_mm]
        return found + depth_notices(medians_mm, fused.settings)
