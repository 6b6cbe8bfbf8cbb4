"""Depth of a clip of D4D against the structured light that measured the tissue before and after it was deformed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.result.depth_maps import DepthReader
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.datasets.d4d import D4dClip, End


def structured_light_errors(run: Path, clip: Path) -> dict[str, float]:
    """Compare a run's depth with the structured light before and after the deformation of a clip of D4D.

    before_mm, after_mm : median differences, after one scale for both, the median ratio. still_mm : of the light after
    from that before, pixel by pixel. Raises `InputError` without the light or the depth.
    """
    sequence, depth = open_truth(run, clip), DepthReader(run)
    source = sequence.source
    assert isinstance(source, D4dClip)
    found, true = [], []
    ends: dict[End, int] = {"start": source.numbers[0], "end": source.numbers[-1]}
    for end, index in ends.items():
        light_mm, estimated_mm = source.structured_light_mm(end), depth.read(index)
        if light_mm is None or estimated_mm is None:
            raise InputError(f"{clip if light_mm is None else run} has no depth of frame {index} to compare")
        true.append(sequence.depth_rectifier.nearest(light_mm))
        found.append(estimated_mm)
    scale = np.nanmedian(np.stack(true) / np.stack(found))
    before, after = (float(np.nanmedian(np.abs(scale * f - t))) for f, t in zip(found, true, strict=True))
    return {"before_mm": before, "after_mm": after, "still_mm": float(np.nanmedian(np.abs(true[1] - true[0])))}
