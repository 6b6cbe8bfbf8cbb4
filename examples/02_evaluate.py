"""Measure a trajectory against the truth, under each alignment.

    python examples/02_evaluate.py [RUN_OR_TRAJECTORY TRUTH]

Both may be a run's folder, a data set's folder, or a TUM, KITTI or C3VD trajectory file. Without arguments a tiny
phantom is rendered and reconstructed first.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from scopemap import ScopemapError, evaluate_poses, open_sequence, read_trajectory, reconstruct
from scopemap_bench import PhantomSpec, write_phantom


def main(run: Path, truth: Path) -> None:
    estimate, reference = read_trajectory(run), read_trajectory(truth)
    for align in ("origin", "se3", "sim3"):
        report = evaluate_poses(estimate, reference, align)
        print(
            f"{align:6}: ATE {report['ate_rmse_mm']:.3f} mm, rotation {report['rotation_mean_deg']:.2f} deg, "
            f"scale {report['scale']:.3f}, {report['tracked']} of {report['frames']} frames tracked"
        )


if __name__ == "__main__":
    try:
        if len(sys.argv) == 3:
            main(Path(sys.argv[1]), Path(sys.argv[2]))
        else:
            with tempfile.TemporaryDirectory() as temporary:
                phantom, run = Path(temporary) / "phantom", Path(temporary) / "run"
                write_phantom(PhantomSpec(frames=8, width=160, height=128), phantom)
                reconstruct(open_sequence(phantom), out=run)
                main(run, phantom)
    except ScopemapError as error:
        sys.exit(str(error))
