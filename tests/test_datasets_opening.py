"""Which folder a named reader is given, and which camera wins over one that cannot be used."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from drawn_datasets import write_pictures
from drawn_inputs import picture, save, write_sevenscenes, write_video
from drawn_scared import write_scared_c
from test_datasets_colmap import NAMES, stored_pose, write_model
from test_datasets_colmap import write_scene as write_colmap
from test_datasets_endonerf import at_rest, llff
from test_datasets_endonerf import write_scene as write_llff
from test_datasets_oneslam import write_json, write_oneslam
from test_datasets_servct import write_experiment
from test_datasets_tum import ROOM, write_tum

from scopemap.calibration import write_calibration
from scopemap.camera import PinholeCamera
from scopemap.datasets import open_sequence
from scopemap.errors import InputError, ScopemapError

MINE = PinholeCamera(60.0, 60.0, 40.0, 32.0, 80, 64)


@pytest.mark.parametrize("write", [write_oneslam, write_colmap, write_llff])
@pytest.mark.parametrize("nesting", ["", "outer"])
def test_images_can_be_named_where_a_data_set_is(write: Callable[[Path], Path], nesting: str, tmp_path: Path) -> None:
    folder = write(tmp_path / nesting / "proj")
    sequence = open_sequence(tmp_path if nesting else folder, dataset="images")
    assert (sequence.source.name, sequence.path) == ("images", folder / "images")
    assert not sequence.calibrated


@pytest.mark.parametrize("dataset", ["oneslam", "colmap"])
def test_a_named_reader_finds_its_own_from_above(dataset: str, tmp_path: Path) -> None:
    writers = {"oneslam": write_oneslam, "colmap": write_colmap}
    folders = {name: write(tmp_path / name) for name, write in writers.items()}
    with pytest.raises(InputError, match="holds 2 sequences"):
        open_sequence(tmp_path)
    assert open_sequence(tmp_path, dataset=dataset).path == folders[dataset]


def test_a_named_reader_that_recognises_nothing_gets_what_was_given(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", 3)
    write_pictures(tmp_path / "masks")
    assert open_sequence(tmp_path).path == tmp_path / "masks"
    assert open_sequence(tmp_path, dataset="stereomis").path == tmp_path
    with pytest.raises(InputError, match=f"reading {tmp_path} as video: it is a folder"):
        open_sequence(tmp_path, dataset="video")
    with pytest.raises(InputError, match=r"clip\.mp4 as images: it is a file"):
        open_sequence(tmp_path / "clip.mp4", dataset="images")


def two_cameras(folder: Path) -> Path:
    write_colmap(folder)
    registered = [(name, 1 + (number == 10), stored_pose(number)) for number, name in NAMES.items()]
    pinhole = {number: ("SIMPLE_PINHOLE", 80, 64, (60.0 + number, 41.0, 30.0)) for number in (1, 2)}
    write_model(folder / "sparse" / "0", registered, pinhole)
    return folder


def unknown_lens(folder: Path) -> Path:
    return write_colmap(folder, camera=("EUCM", 80, 64, (61.0, 62.0, 41.0, 30.0, 0.5, 1.0)))


def focal_length_of_no_camera(folder: Path) -> Path:
    return write_llff(folder, llff(at_rest(), focal_px=1e9))


def calibration_of_larger_images(folder: Path) -> Path:
    write_json(write_oneslam(folder), {"intrinsics": {"fx": 900, "fy": 900, "cx": 40, "cy": 32}})
    return folder


def damaged_calibration(folder: Path) -> Path:
    write_experiment(folder)
    next((folder / "Rectified_calibration").iterdir()).write_text(json.dumps({"P1": 3}))
    return folder


def room_of_another_aspect(folder: Path) -> Path:
    room = write_tum(folder / ROOM)
    for file in (room / "rgb").iterdir():
        save(file, picture(0, (80, 40)))
    return room


def frames_of_another_aspect(folder: Path) -> Path:
    write_sevenscenes(folder)
    for file in folder.glob("*.color.*"):
        save(file, picture(0, (80, 40)))
    return folder


FAULTY = [
    two_cameras, unknown_lens, focal_length_of_no_camera, calibration_of_larger_images, damaged_calibration,
    room_of_another_aspect, frames_of_another_aspect,
]  # fmt: skip


@pytest.mark.parametrize("write", FAULTY)
def test_a_camera_that_is_given_rescues_a_data_set_whose_own_cannot_be_used(
    write: Callable[[Path], Path], tmp_path: Path
) -> None:
    folder = write(tmp_path / "input")
    with pytest.raises(ScopemapError) as caught:
        open_sequence(folder)
    (tmp_path / "mine.txt").write_text("60 60 30 20")
    source = open_sequence(folder, camera=tmp_path / "mine.txt").source
    assert (source.camera, str(source.camera_fault)) == (None, str(caught.value))
    assert source.name != "images"


def test_so_is_a_keyframe_of_scared_c_without_its_calibration(tmp_path: Path) -> None:
    keyframe = write_scared_c(tmp_path / "input", [2, 3, 5, 9])
    (keyframe / "intrinsics_colmap.yaml").unlink()
    with pytest.raises(ScopemapError, match=r"give a calibration \(--camera\)"):
        open_sequence(keyframe, dataset="scared-c")
    (tmp_path / "mine.txt").write_text("60 60 30 20")
    assert open_sequence(keyframe, dataset="scared-c", camera=tmp_path / "mine.txt").camera.fx == 60.0


@pytest.mark.parametrize("own", [False, True])
def test_the_calibration_in_the_folder_comes_before_that_beside_the_images(own: bool, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    write_calibration(MINE, folder / "images" / "camera.yaml")
    if own:
        write_calibration(PinholeCamera(50.0, 50.0, 40.0, 32.0, 80, 64), folder / "camera.yaml")
    assert open_sequence(folder).camera.fx == (50.0 if own else 60.0)
