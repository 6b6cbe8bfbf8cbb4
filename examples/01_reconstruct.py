"""From a video to poses and a surface in six lines.

    python examples/01_reconstruct.py [VIDEO_OR_FOLDER [OUT]]     # OUT: result

Without arguments a tiny phantom is rendered and reconstructed in a temporary folder.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from scopemap import Config, ScopemapError, open_sequence, reconstruct
from scopemap_bench import PhantomSpec, write_phantom


def main(source: Path, out: Path) -> None:
    sequence = open_sequence(source)
    result = reconstruct(sequence, Config(), out=out)
    trajectory = result.trajectory
    print(f"{int(trajectory.tracked.sum())} of {len(trajectory)} frames tracked, {trajectory.path_length_mm:.1f} mm")
    print(f"surface: {len(result.mesh.vertices)} vertices, {len(result.mesh.faces)} faces")
    print(f"scale: {result.provenance['estimators']['anchor']}")


if __name__ == "__main__":
    try:
        if len(sys.argv) > 1:
            main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "result"))
        else:
            with tempfile.TemporaryDirectory() as temporary:
                phantom = Path(temporary) / "phantom"
                write_phantom(PhantomSpec(frames=8, width=160, height=128), phantom)
                main(phantom, Path(temporary) / "run")
    except ScopemapError as error:
        sys.exit(str(error))
