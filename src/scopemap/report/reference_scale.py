"""Sizes by a reference that was set by hand: a result of unknown scale in mm, as its exports hold it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from scopemap.report.measured_by_hand import folder_in_whole, read_measurements
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result


@dataclass(frozen=True)
class ReferenceScale:
    """What a reference says of a result: times `factor` its numbers are mm, on the surface of one segment.

    length_mm : of the reference. frame, segment : of its pixels.
    """

    factor: float
    length_mm: float
    frame: int
    segment: int

    @property
    def words(self) -> str:
        """The reference, in words."""
        return f"reference of {self.length_mm:g} mm in frame {self.frame}"


def reference_scale(run: Result) -> ReferenceScale | None:
    """Return the scale that is kept for a result, or a submap, of unknown scale by a reference of known length.

    None where no such reference is kept, or the scale is known without it.
    """
    if run.scale_known:
        return None
    whole = run.folder.resolve().parent.parent if run.is_submap else run.folder
    here = folder_in_whole(run)
    for one in read_measurements(whole):
        if (one["kind"], one["folder"]) != ("reference", here) or not one["reference_mm"] or len(one["world"]) != 2:
            continue
        length = float(np.linalg.norm(np.subtract(*one["world"])))
        if length > 0 and one["frame"] in run.tracked["index"]:
            factor = one["reference_mm"] / length
            return ReferenceScale(factor, one["reference_mm"], one["frame"], run.segment_at(one["frame"]))
    return None


def holds_for(known: ReferenceScale, run: Result, segment: int | None) -> bool:
    """Return whether a reference gives the scale of a segment's surface; None: of all frames of the result.

    Each segment was reconstructed with a scale of its own: a reference says nothing of another one.
    """
    return len(run.segments) < 2 if segment is None else known.segment == segment


def in_mm(run: Result, segment: int | None) -> Result:
    """Return a result of which surfaces, poses and depth are in mm by the reference, where that gives their scale.

    segment : the one whose surface is written, `mesh` of what is returned; None: all frames are written. Elsewhere the
    numbers are those of `run`. `scale` of what is returned says what the reference gives.
    """
    known, found = reference_scale(run), Result(run.folder, run.input_path)
    if segment is not None:
        found.mesh = run.surface(segment)
        found.textured = run.textured if segment == run.main_segment else None
    if known is None:
        return found
    facts = run.provenance.get("scale") or {}
    if not holds_for(known, run, segment):
        part = run.segments[known.segment].words
        unknown = f"{facts.get('source', 'not stated')}; the {known.words} holds only for the part from {part}"
        found.provenance = run.provenance | {"scale": {**facts, "known": False, "source": unknown}}
        return found
    source = f"{known.words}; numbers are those of the result times {known.factor:.4g}"
    found.provenance = run.provenance | {"scale": {"known": True, "stated": True, "source": source}}
    found.mesh = _enlarged(found.mesh, known.factor)
    if found.textured is not None:
        found.textured = _enlarged(found.textured, known.factor)
    found.frames = _with_longer_paths(run.frames, known.factor)
    found.depth.scale_mm *= known.factor
    return found


def _enlarged(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    """Return a surface with vertices, and their standard deviations, times a factor."""
    larger = mesh.copy().apply_scale(factor)
    if "sigma_mm" in larger.vertex_attributes:
        larger.vertex_attributes["sigma_mm"] = np.asarray(mesh.vertex_attributes["sigma_mm"]) * np.float32(factor)
    return larger


def _with_longer_paths(frames: FrameTable, factor: float) -> FrameTable:
    rows = frames.rows.copy()
    rows["T_world_camera"][:, :3, 3] *= factor
    rows["median_depth_mm"] *= factor
    return FrameTable(rows)
