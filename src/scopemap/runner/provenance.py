"""What a run says of itself beside its result, what it refuses, and what one without an end may keep."""

from __future__ import annotations

import math
import platform
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.estimators import estimators_provenance, package_versions, scale_facts
from scopemap.io.sequence import Sequence
from scopemap.notices import Notice, of_input
from scopemap.preprocessing import Estimators
from scopemap.reconstruction import FrameRecord, frame_counts

_MOVING_SHARE = 0.1  # of the picture: less may be chance, such as a few false matches


@dataclass(frozen=True)
class Limits:
    """What a run without an end may keep; None: no limit.

    frames : records; beyond it every second one of the older half is forgotten, again and again. maps : those of most
    frames, beside the present one, keep a surface. blocks : of 8^3 voxels in all surfaces, 12 KiB each; beyond it all
    maps but the present one lose theirs, and then nothing more is fused.
    """

    frames: int | None = None
    maps: int | None = None
    blocks: int | None = None


def motion_notices(records: list[FrameRecord], config: Config) -> list[Notice]:
    """Return whether the camera was stated to be at rest, and where and how often tissue moves on its own."""
    found = [Notice("camera-at-rest-stated")] if config.tracking.camera_at_rest else []
    measured = [(record.index, *record.track.moving) for record in records if record.T_world_camera is not None]
    measured = [one for one in measured if not math.isnan(one[1])]
    moving = [one for one in measured if one[1] > _MOVING_SHARE]
    if not moving:
        return found
    index, share, x, y = max(moving, key=lambda one: one[1])
    counts = {"frames": len(moving), "measured": len(measured), "threshold": _MOVING_SHARE}
    return [*found, Notice("tissue-moves", counts | {"most": index, "share": share, "x": x, "y": y})]


def refuse_own_input(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where the result would replace what the run reads."""
    kind, _, folder = config.depth.backend.partition(":")
    for source in [sequence.path, *([Path(folder)] if kind == "files" else [])]:
        if source.resolve().is_relative_to(out.resolve()):
            raise InputError(f"cannot write a run to {out}: its input {source} is in it; name another folder")


def provenance_of(
    sequence: Sequence, estimators: Estimators, seconds: dict[str, float], records: list[FrameRecord]
) -> dict[str, Any]:
    """Return what a result of a sequence was made from, and how; `seconds` of each part so far."""
    camera = sequence.camera
    return {
        "input": str(sequence.path),
        "dataset": sequence.source.name,
        **frame_counts(records),
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
        "notices": [notice.as_json() for notice in of_input(sequence.source.notes, sequence.warnings)],
        "seconds": {part: round(seconds, 3) for part, seconds in seconds.items()},
        "versions": package_versions(),
        "machine": f"{platform.system()} {platform.machine()}, {platform.processor() or 'unknown processor'}",
    }
