"""A tiny made-up copy of every layout that a reader knows, by the reader's name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.result.reference import reference_trajectory
from scopemap_bench.datasets.survey import survey
from tests.support.drawn_bags import write_bag1, write_mcap, write_ros2
from tests.support.drawn_calibrations import CAMERAS, write_forms
from tests.support.drawn_climb import write_clip
from tests.support.drawn_colmap import write_colmap
from tests.support.drawn_dicom import write_dicom_video, write_frames
from tests.support.drawn_image_sets import (
    write_d4d,
    write_endogslam,
    write_endonerf,
    write_experiment,
    write_oneslam,
    write_real,
    write_rectified,
    write_sim,
    write_simcol,
    write_tracking,
    write_tum,
    write_unity,
    write_v2,
)
from tests.support.drawn_inputs import picture, save, write_c3vd, write_sevenscenes, write_video
from tests.support.drawn_scared import write_scared, write_scared_c
from tests.support.drawn_video_sets import write_endomapper_with_model, write_stereomis, write_stir


def write_pictures(folder: Path) -> Path:
    folder.mkdir()
    for number in range(4):
        save(folder / f"{number:03d}.png", picture(number))
    return folder


Writer = Callable[[Path], Path]

# Each makes the folder, which does not exist yet, and returns what is to be opened; after a colon, another form.
WRITERS: dict[str, Writer] = {
    "images": write_pictures,
    "video": lambda folder: write_video(_made(folder) / "clip.mp4", 6),
    "c3vd": lambda folder: write_c3vd(folder, 4),
    "c3vd:v2": write_v2,
    "c3vd:endogslam": write_endogslam,
    "7-scenes": write_sevenscenes,
    "scared": write_scared,
    "scared-c": lambda folder: write_scared_c(folder, [2, 3, 5, 9]),
    "hamlyn": write_rectified,
    "hamlyn-tracking": write_tracking,
    "endonerf": write_endonerf,
    "serv-ct": write_experiment,
    "tum": write_tum,
    "oneslam": write_oneslam,
    "simcol3d": write_simcol,
    "endoslam:unity": lambda folder: write_unity(folder / "UnityCam" / "Colon"),
    "endoslam:real": lambda folder: write_real(folder / "HighCam" / "Colon-IV" / "TumorfreeTrajectory_1"),
    "stereomis": write_stereomis,
    "stir": write_stir,
    "d4d": write_d4d,
    "endomapper": write_endomapper_with_model,
    "climb": write_clip,
    "endomapper-sim": write_sim,
    "colmap:txt": write_colmap,
    "colmap:bin": lambda folder: write_colmap(folder, "bin"),
    "rosbag:bag": write_bag1,
    "rosbag:ros2": write_ros2,
    "rosbag:mcap": write_mcap,
    "dicom:video": write_dicom_video,
    "dicom:frames": write_frames,
}


def read_all(path: Path) -> None:
    """Read all that a data set holds, by every way that there is."""
    sequence = open_sequence(path)
    reference_trajectory(sequence)
    survey(sequence)
    for _ in sequence:
        pass


def write_cameras(folder: Path) -> Path:
    """Write calibrations of every model in every form: not a data set, but read as freely."""
    _made(folder)
    for number, camera in enumerate(CAMERAS):
        write_calibration(camera, folder / f"{number}.yaml", depth_scale_mm=0.01)
    for ending in ("xml", "json"):
        storage = cv2.FileStorage(str(folder / f"opencv.{ending}"), cv2.FILE_STORAGE_WRITE)
        storage.write("K", CAMERAS[0].matrix)
        storage.write("D", np.array([[-0.3, 0.1, 1e-3, -5e-4, -0.01]]))
        storage.release()
    write_forms(folder)
    return folder


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
