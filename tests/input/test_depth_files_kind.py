"""Depth files that do not say what they are: depth or inverse depth, their unit, and which picture they belong to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.engine.notices import Notice
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.depth_files import FilesDepth, depth_files
from scopemap.input.depth_kind import KindEvidence
from scopemap.input.opening import open_sequence
from scopemap.result.wording import text_of
from scopemap.runner.preparation import prepare
from scopemap_bench.phantom.spec import C3VD_DEPTH_SCALE_MM
from tests.support.tiny_phantom import only_images, write_black, write_tiny

Write = Callable[[Path, int, np.ndarray], None]


def _levels(folder: Path, number: int, values: np.ndarray) -> None:
    """16 bits over 3 mm more than the phantom's largest depth, or over all inverse depth."""
    cv2.imwrite(str(folder / f"{number:04d}.png"), np.clip(values, 0, 65535).astype(np.uint16))


def _floats(folder: Path, number: int, values: np.ndarray) -> None:
    np.save(folder / f"{number:04d}.npy", values.astype(np.float32))


def depth_mm(phantom: Path, number: int) -> np.ndarray:
    levels = cv2.imread(str(phantom / f"{number:04d}_depth.tiff"), cv2.IMREAD_UNCHANGED)
    return np.where(levels > 0, levels * C3VD_DEPTH_SCALE_MM, np.nan)


def stretched(inverse: np.ndarray) -> np.ndarray:
    """Relative inverse depth of a network: 0 for the farthest, 1 for the nearest, an unknown shift."""
    low, high = np.nanmin(inverse), np.nanmax(inverse)
    return np.nan_to_num((inverse - low) / (high - low))


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "true")


@pytest.fixture(scope="module")
def pictures(phantom: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return only_images(phantom, tmp_path_factory.mktemp("bare") / "pictures")


def write(phantom: Path, folder: Path, save: Write, values_of: Callable[[np.ndarray], np.ndarray]) -> Path:
    folder.mkdir()
    for number in range(9):
        save(folder, number, values_of(depth_mm(phantom, number)))
    return folder


def prepared(pictures: Path, phantom: Path | None, depth: Path, **settings: object) -> tuple[FilesDepth, list[Notice]]:
    camera = None if phantom is None else phantom / "camera.yaml"
    config = Config.load(settings={"depth.backend": f"files:{depth}", "input.focal": "assume", **settings})  # type: ignore[arg-type]
    ready = prepare(open_sequence(pictures, camera=camera), config, lambda part, call, *given: call(*given), _silent)
    assert isinstance(ready[2].depth, FilesDepth)
    assert ready[1].depth.files_kind in (ready[2].depth.kind, "auto")
    return ready[2].depth, ready[3]


def _silent(doing: str, done: int, total: int) -> None:
    pass


DEPTH_16 = (_levels, lambda mm: 100 * np.nan_to_num(mm))
INVERSE = {
    "16 bit, relative": (_levels, lambda mm: 65535 * stretched(1 / mm)),
    "16 bit, true": (_levels, lambda mm: 200000 / mm),
    "floats, relative": (_floats, lambda mm: stretched(1 / mm)),
    "floats, per metre": (_floats, lambda mm: 1000 / mm),
}


@pytest.mark.slow
@pytest.mark.parametrize("form", INVERSE)
def test_the_first_frames_tell_inverse_depth(form: str, phantom: Path, pictures: Path, tmp_path: Path) -> None:
    depth, notices = prepared(pictures, phantom, write(phantom, tmp_path / "files", *INVERSE[form]))
    assert depth.kind == "disparity"
    (notice,) = [notice for notice in notices if notice.code == "depth-files-kind"]
    assert "inverse depth (near is large): " in text_of(notice)
    assert "the camera motion shows it" in text_of(notice)
    assert len(text_of(notice)) <= 120


def test_the_first_frames_tell_depth(phantom: Path, pictures: Path, tmp_path: Path) -> None:
    depth, notices = prepared(pictures, phantom, write(phantom, tmp_path / "mm", _floats, lambda mm: mm))
    assert depth.kind == "measured"
    assert ["depth (far is large)" in text_of(notice) for notice in notices] == [True]


def test_what_a_user_states_is_not_questioned(phantom: Path, pictures: Path, tmp_path: Path) -> None:
    folder = write(phantom, tmp_path / "files", *INVERSE["16 bit, relative"])
    depth, notices = prepared(pictures, phantom, folder, **{"depth.files_kind": "disparity"})
    assert (depth.kind, notices) == ("disparity", [])


def test_what_files_imply_is_refused_where_the_frames_contradict_it(
    phantom: Path, pictures: Path, tmp_path: Path
) -> None:
    """8 bits imply disparity, a stated unit depth."""

    def grey(folder: Path, number: int, values: np.ndarray) -> None:
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.nan_to_num(values).astype(np.uint8))

    far_is_bright = write(phantom, tmp_path / "grey", grey, lambda mm: 2 * mm)
    with pytest.raises(InputError, match=r"they have 8 bits, but are depth .*depth\.files_kind"):
        prepared(pictures, phantom, far_is_bright)
    inverse = write(phantom, tmp_path / "inverse", *INVERSE["16 bit, relative"])
    with pytest.raises(InputError, match=r"files_scale_mm states their unit, but are inverse.*depth\.files_kind"):
        prepared(pictures, phantom, inverse, **{"depth.files_scale_mm": 0.001})


def test_files_that_the_first_frames_cannot_decide_are_refused(tmp_path: Path) -> None:
    """Of black pictures neither motion nor network says anything; what the setting states is taken."""
    black = write_black(tmp_path / "black")
    folder = tmp_path / "files"
    folder.mkdir()
    for number in range(4):
        _levels(folder, number, np.random.default_rng(number).uniform(10, 90, (128, 160)))
    with pytest.raises(InputError, match=r"depth or inverse depth, .*state --set depth\.files_kind=disparity if"):
        prepared(black, None, folder)
    assert prepared(black, None, folder, **{"depth.files_kind": "measured"})[0].kind == "measured"


CONTENTLESS: dict[str, tuple[Write, Callable[[np.ndarray], np.ndarray], str]] = {
    "zeros": (_levels, np.zeros_like, "hold no positive number"),
    "unknown": (_floats, lambda mm: mm * np.nan, "hold no positive number"),
    "negative": (_floats, lambda mm: -mm, "hold no positive number"),
    "one number": (_floats, lambda mm: 0 * mm + 30, "hold one number everywhere, such as 30"),
    "one level": (_levels, lambda mm: np.full(mm.shape, 9), "hold one number everywhere, such as 9"),
    "stretched": (
        _floats,
        lambda mm: 0.1 + 254.9 * stretched(np.where(mm < 99, mm, np.nan)),  # the phantom's depth is cut off at 100 mm
        "each reach from 0.1 to 255: each frame was stretched by itself",
    ),
    "logarithm": (_floats, np.log, r"vary \d\.\d times less: they may be logarithms of depth"),
}


@pytest.mark.parametrize("form", CONTENTLESS)
def test_files_that_are_no_depth_in_mm_are_refused(form: str, phantom: Path, pictures: Path, tmp_path: Path) -> None:
    """They ended in a result, with known sizes, or in the advice to state a kind that they do not have."""
    save, values_of, message = CONTENTLESS[form]
    with pytest.raises(InputError, match=message):
        prepared(pictures, phantom, write(phantom, tmp_path / "files", save, values_of))


def test_depth_that_is_cut_off_at_a_farthest_one_is_not_taken_for_stretched(
    phantom: Path, pictures: Path, tmp_path: Path
) -> None:
    """Its largest number is the same in each file, too, but in many pixels."""
    folder = write(phantom, tmp_path / "files", _floats, lambda mm: np.clip(np.nan_to_num(mm), 0, 40))
    assert prepared(pictures, phantom, folder)[0].kind == "measured"


def test_motion_and_network_decide_together() -> None:
    nan = float("nan")
    assert KindEvidence((9.0, 9.0), nan, 2).sign == 1
    assert KindEvidence((-9.0, -9.0), -0.4, 2).sign == -1
    # Windows that hardly tell do not outvote those that do.
    assert KindEvidence((9.0, 9.0, -0.1, -0.1), nan, 4).sign == 1
    assert KindEvidence((), -0.95, 2).sign == -1
    assert KindEvidence((0.5, -0.2), 0.97, 2).sign == 1
    for motion, network in (((), nan), ((), 0.8), ((9.0, 9.0), -0.95), ((-4.0,), 0.95), ((9.0, -5.0, 5.0), nan)):
        assert KindEvidence(motion, network, 2).sign == 0


@pytest.mark.parametrize(
    ("per_mm", "scale_mm", "advice"),
    [
        (1e-3, None, "files_scale_mm=1000 if they are in metres"),
        (5.0, 5000.0, r"files_scale_mm=0\.2 if they are 5000 levels per metre"),
        (256.0, 256.0, r"files_scale_mm=0\.00390625 if they are 256 levels per mm"),
        (1000.0, None, r"files_scale_mm=0\.001 if they are in micrometres"),
    ],
)
def test_a_unit_that_no_endoscope_has_is_refused_with_one_that_fits(
    per_mm: float, scale_mm: float | None, advice: str, phantom: Path, pictures: Path, tmp_path: Path
) -> None:
    folder = write(phantom, tmp_path / "files", _floats, lambda mm: per_mm * mm)
    settings = {"depth.files_kind": "measured", "depth.files_scale_mm": scale_mm}
    with pytest.raises(InputError, match=rf"endoscopes see 1 to 500 mm: .*(?:{advice})"):
        prepared(pictures, phantom, folder, **settings)


def test_a_calibration_that_states_levels_per_metre_is_refused(phantom: Path, pictures: Path, tmp_path: Path) -> None:
    folder = write(phantom, tmp_path / "files", _levels, lambda mm: 5 * np.nan_to_num(mm))
    camera = (phantom / "camera.yaml").read_text()
    assert "depth_scale: " in camera
    lines = ["depth_scale: 5000." if line.startswith("depth_scale: ") else line for line in camera.splitlines()]
    (tmp_path / "camera.yaml").write_text("\n".join(lines) + "\n")
    assert read_calibration(tmp_path / "camera.yaml", (160, 128)).depth_scale_mm == 5000
    with pytest.raises(InputError, match=r"files_scale_mm=0\.2 if they are 5000 levels per metre"):
        prepared(pictures, tmp_path, folder, **{"depth.files_kind": "measured"})


def test_a_stated_range_allows_for_larger_scenes(phantom: Path, pictures: Path, tmp_path: Path) -> None:
    folder = write(phantom, tmp_path / "files", _floats, lambda mm: 100 * mm)
    given = {"depth.files_kind": "measured"}
    assert prepared(pictures, phantom, folder, **given, **{"depth.near_far_mm": (500.0, 20000.0)})[0].kind == "measured"
    with pytest.raises(InputError, match="endoscopes see"):
        prepared(pictures, phantom, folder, **given)


@pytest.mark.parametrize(
    "name",
    [
        "{stem}.png",
        "{stem}.npy",
        "{stem}-dpt_beit_large_512.png",
        "{stem}_depth.png",
        "depth_{stem}.tif",
        "{number}.png",
    ],
)
@pytest.mark.parametrize("picture", ["{:04d}_color", "frame{:04d}_rgb", "{:04d}_cam0", "left-{:02d}"])
def test_files_named_as_their_pictures_belong_to_them(picture: str, name: str, tmp_path: Path) -> None:
    pictures = {10 + i: tmp_path / f"{picture.format(10 + i)}.jpg" for i in range(3)}
    for number, file in pictures.items():
        (tmp_path / name.format(stem=file.stem, number=number)).touch()
        (tmp_path / f"{file.stem}_mask.png").touch()
        file.touch()
    found = depth_files(tmp_path, pictures)
    assert {number: name.format(stem=file.stem, number=number) for number, file in pictures.items()} == {
        number: file.name for number, file in found.items()
    }


def test_names_of_colour_are_read_where_there_is_no_other(tmp_path: Path) -> None:
    """Of a video there are no pictures; beside depth, and as the pictures themselves, they are left out."""
    for number in range(3):
        (tmp_path / f"{number}_color.png").touch()
    assert list(depth_files(tmp_path)) == [0, 1, 2]
    with pytest.raises(InputError, match="could be depth"):
        depth_files(tmp_path, {number: tmp_path / f"{number}_color.png" for number in range(3)})
    (tmp_path / "1_depth.png").touch()
    assert [file.name for file in depth_files(tmp_path).values()] == ["1_depth.png"]


def test_two_files_of_one_picture_are_refused(tmp_path: Path) -> None:
    pictures = {number: tmp_path / "in" / f"{number}_color.png" for number in range(3)}
    for number in range(3):
        for ending in ("png", "npy"):
            (tmp_path / f"{number}_color.{ending}").touch()
    with pytest.raises(InputError, match=r"0_color\.npy and 0_color\.png are both named as 0_color\.png"):
        depth_files(tmp_path, pictures)
