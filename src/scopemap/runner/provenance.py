"""What a run says of itself beside its result, what it refuses, and what one without an end may keep."""

from __future__ import annotations

import platform
from collections import Counter
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.depth.estimate import DepthEstimator, PerceptualDistance
from scopemap.engine.errors import InputError
from scopemap.engine.estimators import Estimators
from scopemap.engine.finishing import SegmentSurface
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.mapping.segments import Segment
from scopemap.engine.notices import Notice, of_input
from scopemap.engine.tracking.features import FeatureDetector
from scopemap.input.frame_choice import selection_text
from scopemap.input.sequence import Sequence
from scopemap.result.frame_table import FrameTable
from scopemap.result.wording import facts_of_notices

_VERSIONS = ("scopemap", "numpy", "scipy", "opencv-python-headless", "numba", "onnxruntime")
_VERSIONS_OF_NETWORKS = ("torch", "torchvision", "transformers", "lpips")
_FEW_FRAMES = 5
_MOVING_SHARE = 0.1  # of the picture: less may be chance, such as a few false matches


@dataclass(frozen=True)
class Limits:
    """What a run without an end may keep; None: no limit.

    stored : frames on disk, to be corrected after the last one; beyond them, and beyond `frames`, the poses stay as
    tracked and the surface as it is shown. frames : in the table; beyond it every second one of the older half is
    forgotten, again and again. maps : those of
    most frames, beside the present one, keep a surface. blocks : of 8^3 voxels in all surfaces, 12 KiB each; beyond it
    all maps but the present one lose theirs, and then nothing more is fused.
    """

    frames: int | None = None
    maps: int | None = None
    blocks: int | None = None
    stored: int | None = None

    def exceeded(self, *, frames: int, stored: int) -> bool:
        """Return whether a run has so many frames in its table, or stored, that none is corrected at the end."""
        return any(
            limit is not None and count > limit for count, limit in ((frames, self.frames), (stored, self.stored))
        )


def motion_notices(frames: FrameTable, config: Config, *, checked: bool) -> list[Notice]:
    """Return whether no view confirms path and depth, or the camera was stated to be at rest, and where tissue moves.

    checked : whether depth was measured, or an adjustment was tried.
    """
    at_rest = [Notice("camera-at-rest-stated")] if config.tracking.camera_at_rest else []
    found = at_rest or ([] if checked else [Notice("mapping-none")])
    measured = frames.only(frames.tracked & (frames["moving_share"] >= 0))
    moving = int((measured["moving_share"] > _MOVING_SHARE).sum())
    if not moving:
        return found
    most = measured.rows[measured["moving_share"].argmax()]
    place = {"share": float(most["moving_share"]), "x": float(most["moving_x"]), "y": float(most["moving_y"])}
    counts = {"frames": moving, "measured": len(measured), "threshold": _MOVING_SHARE, "most": int(most["index"])}
    return [*found, Notice("tissue-moves", counts | place)]


def notices_of_end(frames: FrameTable, interrupted_at: int | None, forgotten: int, limits: Limits) -> list[Notice]:
    """Return notices where the run was interrupted, by the last frame's number, where few frames are tracked, and where
    some were forgotten.
    """
    tracked = int(frames.tracked.sum())
    found = [] if interrupted_at is None else [Notice("input-interrupted", {"frame": interrupted_at})]
    found += [Notice("frames-few", {"frames": tracked})] if tracked < _FEW_FRAMES else []
    return found + ([Notice("frames-forgotten", {"frames": forgotten, "kept": limits.frames})] if forgotten else [])


def refuse_own_input(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where the result would replace what the run reads."""
    kind, _, folder = config.depth.backend.partition(":")
    sources = [sequence.path]
    if kind == "files":
        sources.append(Path(folder))
    if config.input.second_view is not None:
        sources.append(config.input.second_view)
    for source in sources:
        if source.resolve().is_relative_to(out.resolve()):
            raise InputError(f"cannot write a run to {out}: its input {source} is in it; name another folder")


def provenance_of(
    sequence: Sequence, estimators: Estimators, seconds: dict[str, float], frames: FrameTable
) -> dict[str, Any]:
    """Return what a result of a sequence was made from, and how; `seconds` of each part so far."""
    camera = sequence.camera
    return {
        "input": str(sequence.path),
        "dataset": sequence.source.name,
        **frames.counts,
        "selection": {"frames": selection_text(sequence.selection), "of": sequence.source.count},
        "skipped": dict(Counter(frame.kind for frame in sequence.skipped)),
        "camera": {
            "source": sequence.camera_source,
            "origin": sequence.camera_origin,
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "focal_sigma_px": sequence.focal_sigma_px,
            "size": sequence.size_source,
        },
        "scale": scale_facts(estimators),
        "estimators": estimators_provenance(estimators),
        "notices": facts_of_notices(of_input(sequence.source.notes, sequence.warnings)),
        "seconds": {part: round(seconds, 3) for part, seconds in seconds.items()},
        "versions": package_versions(),
        "machine": f"{platform.system()} {platform.machine()}, {platform.processor() or 'unknown processor'}",
    }


def facts_of_segment(segment: Segment, surface: SegmentSurface, frames: FrameTable) -> dict[str, Any]:
    """Return what `provenance.json` has of a segment: its frames, how its surface agrees with them, its notices."""
    own = frames.rows[np.isin(frames["index"], list(segment.frames))]
    first, last = own[0], own[-1]
    return {
        "first_frame": int(first["index"]),
        "last_frame": int(last["index"]),
        "start_s": float(first["time_s"]),
        "end_s": float(last["time_s"]),
        "frames": len(own),
        "joined": segment.is_joined,
        "surface": surface.agreement,
        "faces": len(surface.mesh.faces),
        "notices": facts_of_notices(surface.notices),
    }


def scale_facts(estimators: Estimators) -> dict[str, bool | str]:
    """Return `known`, whether the scale of a run is measured or anchored, `measured`, `stated` (a range that its user
    gave), and its `source` in words.
    """
    depth, anchor = estimators.depth, estimators.anchor
    guessed = anchor.is_measured and not getattr(depth, "scale_is_known", True)
    source = anchor.description + (" of unknown unit" if guessed else "")
    known = anchor.scale_is_known and not guessed
    return {"known": known, "measured": known and anchor.is_measured, "stated": anchor.is_stated, "source": source}


def estimators_provenance(estimators: Estimators) -> dict[str, str]:
    """Return names, versions and hashes of the estimators, and the source of the depth scale."""
    parts = estimators.depth.provenance()
    others: dict[str, DepthEstimator | FlowEstimator | PerceptualDistance | FeatureDetector] = {
        "flow": estimators.flow,
        "perceptual": estimators.perceptual,
        "features": estimators.features,
    }
    if estimators.anchor.reference.name == "depth-pro":
        others["anchor"] = estimators.anchor.reference
    for role, part in others.items():
        # Several parts have weights and hashes: the key names the part.
        facts = part.provenance()
        parts |= {key if key == role else f"{role} {key}": value for key, value in facts.items()}
    masks = {} if estimators.masks is None else estimators.masks.provenance()
    return parts | masks | {"keyframe_flow": estimators.keyframe_flow.name, "anchor": estimators.anchor.description}


@cache
def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on; of `networks` if present."""
    installed = [name for name in _VERSIONS_OF_NETWORKS if find_spec(name) is not None]
    return {name: version(name) for name in (*_VERSIONS, *installed)} | {"python": platform.python_version()}
