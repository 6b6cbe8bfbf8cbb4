"""CLiMB: clips of EndoMapper's colonoscopies with poses by COLMAP in mm (EndoVis at MICCAI 2026).

`Seq_001_a/results_txt/images.txt`, the clip `Seq_001_a.mp4` in that folder or beside it, `scales.csv` beside it. The
camera is found as for EndoMapper: `Calibrations/Endoscope_NN` above, by `Seq_001_info.json` in the folder, or a
`*_geometrical.xml` in it. The challenge does not say where clips and calibrations are; this layout is ours.
"""

from __future__ import annotations

from pathlib import Path

from scopemap_bench.datasets.endomapper import EndoMapperSequence
from scopemap_bench.datasets.posed_video import PosedVideo
from scopemap_bench.trajectories.climb import read_climb_reference


class ClimbClip(EndoMapperSequence):
    """One clip; the reference's image `000001.png` is frame 0."""

    name = "climb"
    quality = "sfm"

    def __init__(self, path: Path) -> None:
        clip = _clip_of(path)
        PosedVideo.__init__(self, path, [clip])
        self._use_endoscope(path / f"{clip.stem.rpartition('_')[0]}_info.json")
        reference = read_climb_reference(path)
        self.poses = dict(zip(reference.indices.tolist(), reference.T_world_camera, strict=True))
        self.notes.append(f"truth: {reference.source}: {len(self.poses)} frames; no depth is known")
        self._warn_of_poses_beyond(clip)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds a reference, and the clip is in it or beside it."""
        return (path / "results_txt" / "images.txt").is_file() and _clip_of(path).is_file()


def _clip_of(folder: Path) -> Path:
    """Return the clip in the folder, else the one beside it, whether or not it is there."""
    name = f"{folder.absolute().name}.mp4"
    return folder / name if (folder / name).is_file() else folder.absolute().parent / name
