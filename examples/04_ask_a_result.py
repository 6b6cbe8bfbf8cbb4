"""Ask a result: what no frame saw, how large something is, and where the frames of another video are.

    python examples/04_ask_a_result.py [RESULT VIDEO]     # VIDEO: another one of the same place

Without arguments a small phantom is rendered, and its first half reconstructed. The phantom's scale is taken to be
unknown, as for most videos: the width of the patch below is the unit. Research software, not a medical device.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from scopemap import Result, ScopemapError, coverage, locate, measure, measure_lesion, open_sequence, reconstruct
from scopemap_bench import PhantomSpec, write_phantom


def main(result: Result, video: Path) -> None:
    found = coverage(result)
    print(found)
    for spot in found.spots:
        print(f"look again at {np.round(spot.position_mm, 1)}: the camera was nearest in frame {spot.frame}")

    # A patch of the wall in the first frame, in multiples of its own width.
    frame, camera = result.frames["index"][result.frames.tracked][0], result.camera
    x, y, half = camera.width / 2, 0.75 * camera.height, camera.width / 16
    left, right = (x - half, y), (x + half, y)
    outline = [left, (x, y - half), right, (x, y + half)]
    for size in measure(result, frame, outline, reference=[left, right]):
        print(size)
    lesion = measure_lesion(result, outline, frame, reference=[left, right])
    print(f"{lesion.measures[0]}, from {len(lesion.masks)} frames; the scale rests on {lesion.scale}")

    located = list(locate(result, video))
    print(f"{sum(one.status == 'found' for one in located)} of {len(located)} frames located")


if __name__ == "__main__":
    try:
        if len(sys.argv) == 3:
            main(Result(sys.argv[1]), Path(sys.argv[2]))
        else:
            with tempfile.TemporaryDirectory() as temporary:
                phantom, run = Path(temporary) / "phantom", Path(temporary) / "run"
                write_phantom(PhantomSpec(frames=16, width=160, height=128), phantom)
                main(reconstruct(open_sequence(phantom, frames=":12"), out=run), phantom)
    except ScopemapError as error:
        sys.exit(str(error))
