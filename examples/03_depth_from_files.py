"""Depth of your own: one file per frame, from whatever network or sensor made it.

    python examples/03_depth_from_files.py [FRAMES DEPTH_FOLDER]

The number in a file's name is the frame's. 8-bit images are taken as disparity, 16-bit images as measured depth, .npy
as depth in mm; `depth.files_kind` and `depth.files_scale_mm` say otherwise. Without arguments the true depth of a tiny
phantom is written as .npy, as a network of your own might, and read back.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from scopemap import Config, ScopemapError, open_sequence, reconstruct
from scopemap_bench import PhantomSpec, write_phantom


def write_depth(frames: Path, folder: Path) -> None:
    folder.mkdir()
    for frame, truth in open_sequence(frames):
        assert truth is not None
        assert truth.depth_mm is not None
        np.save(folder / f"{frame.index:04d}.npy", truth.depth_mm)


def main(frames: Path, depth: Path) -> None:
    config = Config.load(settings={"depth.backend": f"files:{depth}"})
    result = reconstruct(open_sequence(frames), config)
    print(f"depth: {result.provenance['estimators']['depth']} ({result.provenance['estimators']['depth_kind']})")
    print(f"{int(result.trajectory.tracked.sum())} of {len(result.trajectory)} frames tracked")
    print(f"surface: {len(result.mesh.faces)} faces")


if __name__ == "__main__":
    try:
        if len(sys.argv) == 3:
            main(Path(sys.argv[1]), Path(sys.argv[2]))
        else:
            with tempfile.TemporaryDirectory() as temporary:
                phantom, depth = Path(temporary) / "phantom", Path(temporary) / "depth"
                write_phantom(PhantomSpec(frames=8, width=160, height=128), phantom)
                write_depth(phantom, depth)
                main(phantom, depth)
    except ScopemapError as error:
        sys.exit(str(error))
