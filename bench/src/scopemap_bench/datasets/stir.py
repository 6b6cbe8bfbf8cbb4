"""STIR: stereo clips of surgery whose tissue carries points of infrared dye, seen before and after (arXiv 2309.16782).

`LAB/leftNN/seqNN/frames/STARTms-ENDms-*.mp4` (the left view in visible light, where the dye is not seen),
`segmentation/icgstartseg.png` and `icgendseg.png` (the dye, white, in its first and last frame), `LAB/calib.json` with
`leftcameramat`. No pose and no depth is known. Layout and centres are those of github.com/athaddius/STIRLoader.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.input.camera_files.parsing import calibration_bytes
from scopemap.input.decoding import read_decoded
from scopemap_bench.datasets.posed_video import PosedVideo, videos_in

_START = "segmentation/icgstartseg.png"
_END = "segmentation/icgendseg.png"
_CALIBRATION = "calib.json"


class StirClip(PosedVideo):
    """The left view of one clip."""

    name = "stir"

    def __init__(self, path: Path) -> None:
        super().__init__(path, videos_in(path / "frames", ".mp4"))
        file = path.absolute().parents[1] / _CALIBRATION
        if self.camera is None and file.is_file():
            self._set_camera(_read_camera(file, (self.width, self.height)), f"left camera of {file.name}", str(file))
        self.notes.append("no pose and no depth is known, but where points of dye are in the first and the last frame")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds the points of dye in the first frame and a video."""
        return (path / _START).is_file() and bool(videos_in(path / "frames", ".mp4"))

    def tattoos(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres (N, 2) in the first frame and (M, 2) in the last, px; which belong together is not known.

        Raises `InputError` where they cannot be read.
        """
        return _centres(self.path / _START), _centres(self.path / _END)


def _centres(file: Path) -> np.ndarray:
    """Return x + w // 2, y + h // 2 of each white part, as the data set's loader has it."""
    image = read_decoded(file, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"reading {file}: no image")
    boxes = cv2.connectedComponentsWithStats((image > 0).astype(np.uint8))[2][1:, :4]
    return (boxes[:, :2] + boxes[:, 2:] // 2).astype(np.float64)


def _read_camera(file: Path, size: tuple[int, int]) -> CameraModel:
    with reporting(f"cannot read the calibration in {file}: no matrix leftcameramat", kind=CalibrationError):
        stated = json.loads(calibration_bytes(file))
        K = np.array(stated["leftcameramat"], np.float64).reshape(3, 3)
        camera = PinholeCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size)
        lens = tuple(np.array(stated.get("leftdistortioncoeffs", []), np.float64).ravel().tolist())
        return OpenCvCamera(camera, lens) if any(lens) else camera
