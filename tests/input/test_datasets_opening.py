"""Which folder a named reader is given, and which camera wins over one that cannot be used."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from scopemap.engine.errors import CalibrationError, InputError, ScopemapError
from scopemap.input.opening import open_sequence, open_source
from tests.support.drawn_bags import write_bag1
from tests.support.drawn_colmap import NAMES, stored_pose, write_colmap, write_model
from tests.support.drawn_datasets import write_pictures
from tests.support.drawn_dicom import dataset, film, native
from tests.support.drawn_dicom import save as save_dicom
from tests.support.drawn_image_sets import at_rest, llff, write_endonerf, write_json, write_oneslam
from tests.support.drawn_inputs import picture, save, write_c3vd, write_video


@pytest.mark.parametrize("write", [write_oneslam, write_colmap, write_endonerf])
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
    return write_endonerf(folder, llff(at_rest(), focal_px=1e9))


def calibration_of_larger_images(folder: Path) -> Path:
    write_json(write_oneslam(folder), {"intrinsics": {"fx": 900, "fy": 900, "cx": 40, "cy": 32}})
    return folder


FAULTY = [
    two_cameras, unknown_lens, focal_length_of_no_camera, calibration_of_larger_images,
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


def list_of_a_medium(file: Path) -> Path:
    found = dataset()
    found.file_meta.MediaStorageSOPClassUID = found.SOPClassUID = "1.2.840.10008.1.3.10"
    return save_dicom(found, file)


@pytest.mark.parametrize("name", ["clip.bag", "report.dcm"])
def test_a_container_that_lies_about_hides_nothing(name: str, tmp_path: Path) -> None:
    if name == "clip.bag":
        write_bag1(tmp_path)
    else:
        native(tmp_path / name, film())
    kinds = {"images": write_pictures, "sequence": write_c3vd}
    for inner, write in kinds.items():
        write(tmp_path / inner)
        assert open_sequence(tmp_path).path == tmp_path / inner
        shutil.rmtree(tmp_path / inner)


def test_containers_beside_a_data_set_do_not_count_and_without_one_do(tmp_path: Path) -> None:
    native(tmp_path / "ct" / "a.dcm", film())
    write_c3vd(tmp_path / "deeper" / "sequence")
    write_video(tmp_path / "clip.mp4", 3)
    assert open_sequence(tmp_path).path == tmp_path / "deeper" / "sequence"
    assert open_sequence(tmp_path, dataset="dicom").path == tmp_path / "ct"
    shutil.rmtree(tmp_path / "deeper")
    assert open_sequence(tmp_path).path == tmp_path / "ct"


def test_the_list_of_what_a_medium_holds_is_no_picture(tmp_path: Path) -> None:
    list_of_a_medium(tmp_path / "DICOMDIR")
    folder = native(tmp_path / "DICOM" / "A" / "IM01", film()).parent
    assert open_sequence(tmp_path).path == folder
    list_of_a_medium(folder / "DICOMDIR")
    assert open_sequence(folder).warnings == []


@pytest.mark.parametrize("text", ["%YAML:1.0\n---\nnothing", "500 500 320 240 0 0"])
def test_a_source_is_opened_whatever_its_camera(text: str, tmp_path: Path) -> None:
    for i in range(3):
        save(tmp_path / f"{i}.png", picture(i))
    (tmp_path / "camera.yaml").write_text(text)
    source = open_source(tmp_path)
    assert [frame.index for frame in source.frames(slice(None))] == [0, 1, 2]
    with pytest.raises(CalibrationError, match=r"camera\.yaml"):
        open_sequence(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        open_source(tmp_path / "none")
    mine = tmp_path / "mine.txt"
    mine.write_text("60 60 67 53")
    assert open_sequence(tmp_path, camera=mine).calibrated
