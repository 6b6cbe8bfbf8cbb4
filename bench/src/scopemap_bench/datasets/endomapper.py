"""EndoMapper: whole colonoscopies and gastroscopies, some with poses by structure from motion.

`Sequences/Seq_NNN/{Seq_NNN.mov, Seq_NNN_info.json, meta-data/colmap/Seq_NNN.zip}`; the info file names the endoscope,
whose calibration is `Calibrations/Endoscope_NN/Endoscope_NN_geometrical.xml`. COLMAP's sub-models share neither frame
nor scale: the largest one is used. Azagra et al., Scientific Data 10, 671 (2023), doi 10.1038/s41597-023-02564-7.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from scopemap.engine.errors import InputError, reporting
from scopemap.input.camera_files.colmap_model import read_largest_model
from scopemap.input.camera_files.reading import stated_calibration
from scopemap.input.trajectory.colmap_poses import camera_poses
from scopemap_bench.datasets.posed_video import PosedVideo, videos_in

_PROCEDURE = re.compile(r"Seq_\d+")
_FRAME = re.compile(r"out(\d{1,9})\.\w+")
_ENDOSCOPE = re.compile(r"(?:Endoscope_)?(\d{1,4})")
_UNKNOWN = ("", "n/a", "none")
_GEOMETRICAL = "_geometrical.xml"
_LEVELS_UP = 3


class EndoMapperSequence(PosedVideo):
    """The video of one procedure. COLMAP's image `outN.png` is frame N - 1 of the video."""

    name = "endomapper"
    quality = "sfm"

    def __init__(self, path: Path) -> None:
        videos = videos_in(path, ".mov")
        videos = [file for file in videos if _PROCEDURE.fullmatch(file.stem)] or videos
        super().__init__(path, videos)
        video = videos[0]
        self._use_endoscope(path / f"{video.stem}_info.json")
        self._take_poses(path / "meta-data" / "colmap" / f"{video.stem}.zip")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds `Seq_NNN.mov`, or a video of another name beside a geometrical calibration."""
        videos = videos_in(path, ".mov")
        return any(_PROCEDURE.fullmatch(file.stem) or any(path.glob(f"*{_GEOMETRICAL}")) for file in videos)

    def _use_endoscope(self, info: Path) -> None:
        """Take the calibration of the endoscope that the info file names, unless the folder has its own camera."""
        file = self._calibration_file(info) if self.camera is None else None
        if file is not None:
            camera = stated_calibration(file, (self.width, self.height)).camera
            self._set_camera(camera, f"calibration of the data set, {file.name}", str(file))

    def _calibration_file(self, info: Path) -> Path | None:
        number = read_endoscope(info) if info.is_file() else None
        if number is None:
            beside = sorted(self.path.glob(f"*{_GEOMETRICAL}"))
            if len(beside) == 1:
                return beside[0]
            fault = "names no endoscope" if info.is_file() else "is missing"
            self.notes.append(f"no calibration: {info.name} {fault}")
            return None
        name = f"Endoscope_{number:02d}"
        above = [self.path, *self.path.absolute().parents[:_LEVELS_UP]]
        places = [self.path, *(folder / "Calibrations" / name for folder in above)]
        found = next((file for place in places if (file := place / f"{name}{_GEOMETRICAL}").is_file()), None)
        if found is None:
            self.warnings.append(f"{name}{_GEOMETRICAL} ({info.name}) is not in Calibrations/{name}: camera assumed")
        return found

    def _take_poses(self, archive: Path) -> None:
        if not archive.is_file():
            self.notes.append("no pose is known: there is no COLMAP reconstruction of this procedure")
            return
        images, chosen, count = read_largest_model(archive)
        images = [image for image in images if image.is_posed]
        for image, pose in zip(images, camera_poses(images), strict=True):
            name = image.path.name
            match = _FRAME.fullmatch(name)
            number = int(match[1]) - 1 if match else -1
            if number < 0 or number in self.poses:
                raise InputError(f"reading {archive}: the image name {name!r} is not outN.png, or repeats")
            self.poses[number] = pose
        self.notes += [
            f"the truth is COLMAP sub-model {chosen}, the largest of {count}: {len(self.poses)} frames; its scale is "
            "arbitrary, read as mm",
            "image outN.png is taken as frame N - 1; no depth is known",
        ]
        self._warn_of_poses_beyond(archive)


def read_endoscope(info: Path) -> int | None:
    """Return the endoscope's number, written 1, "1", "Endoscope_01" or "N/A" (None); `InputError` for anything else."""
    with reporting(f"reading {info}: it is no JSON object"):
        stated = json.loads(info.read_text(encoding="utf-8-sig")).get("endoscope_number")
    text = "" if stated is None else str(stated).strip()
    if text.lower() in _UNKNOWN:
        return None
    match = _ENDOSCOPE.fullmatch(text)
    if match is None:
        raise InputError(f"reading {info}: endoscope_number {text[:40]!r} is none: expected 1, 'Endoscope_01' or 'N/A'")
    return int(match[1])
