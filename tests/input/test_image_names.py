"""What the names in a folder of images tell: order, times, and which pictures are no frames of one camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.input.decoding import read_decoded
from scopemap.input.images import ImageFolder
from scopemap.input.opening import open_sequence
from tests.support.drawn_inputs import number_in, picture, save

SIZE = (96, 64)


def _folder(folder: Path, names: list[str]) -> Path:
    """Pictures by number: that of a name is its place."""
    folder.mkdir()
    for number, name in enumerate(names):
        save(folder / f"{name}.png", picture(number, SIZE))
    return folder


def _shown(source: ImageFolder) -> list[int]:
    return [number_in(frame.rgb) for frame in source.frames(slice(None))]


@pytest.mark.parametrize(
    ("names", "step_s"),
    [
        ([f"frame_{k / 15:.3f}".rstrip("0") for k in range(1, 40)], 1 / 15),
        ([f"{float(f'{k / 30:.3g}')}" for k in range(40)], 1 / 30),
        ([f"t{k / 8:g}s" for k in range(40)], 1 / 8),
        ([f"{1305031102 + k / 30:.6f}" for k in range(40)], 1 / 30),
        ([f"frame_{k * 33333333}" for k in range(40)], 0.033333333),
        ([f"{1403636579763555584 + k * 50_000_000}" for k in range(40)], 0.05),
        ([f"{1403636579763555 + k * 40_000}" for k in range(40)], 0.04),
        ([f"img_{1403636579763 + k * 40}" for k in range(40)], 0.04),
    ],
)
def test_times_in_names_are_the_times_of_the_frames(names: list[str], step_s: float, tmp_path: Path) -> None:
    source = ImageFolder(_folder(tmp_path / "images", names))
    assert _shown(source) == list(range(len(names)))
    times_s = [frame.time_s for frame in source.frames(slice(None))]
    np.testing.assert_allclose(np.diff(times_s), step_s, atol=0.011)
    assert np.median(np.diff(times_s)) == pytest.approx(step_s, rel=0.03)
    assert times_s[0] < 2e9
    assert source.stamped
    assert source.notes[0] in [f"time stamps: the numbers in the names, {unit}" for unit in ("s", "ms", "us", "ns")]


@pytest.mark.parametrize(
    "names",
    [
        [f"clip1.{k}" for k in range(1, 31)],
        [f"scan_2.{k}" for k in range(5, 40)],
        [f"scan_2.{k}" for k in range(0, 400, 10)],
        [f"frame.{k:04d}" for k in range(30)],
        [f"v1.{k:04d}" for k in range(30)],
        [f"frame{k}" for k in range(95, 125)],
        [f"video1.{k}" for k in range(85, 124, 2)],
        [f"p1.{k}" for k in range(1, 200, 25)],
    ],
)
def test_counters_behind_a_point_are_no_times(names: list[str], tmp_path: Path) -> None:
    source = ImageFolder(_folder(tmp_path / "images", names))
    assert _shown(source) == list(range(len(names)))
    assert source.numbers == [int(name.split(".")[-1].removeprefix("frame")) for name in names]
    assert not source.stamped


def test_a_date_in_the_names_gives_no_time_of_centuries(tmp_path: Path) -> None:
    source = ImageFolder(_folder(tmp_path / "images", [f"{20231129153303 + k}" for k in range(8)]))
    assert [frame.time_s for frame in source.frames(slice(None))] == pytest.approx([k / 30 for k in range(8)])


N = range(6)


@pytest.mark.parametrize(
    ("used", "others", "said"),
    [
        ("left_{:04d}", ["right_{:04d}"], "show two eyes: the left one is used, 6 pictures of the right"),
        ("{:04d}_L", ["{:04d}_R"], "show two eyes"),
        ("img{:04d}L", ["img{:04d}R"], "show two eyes"),
        ("colonL_{:03d}", ["colonR_{:03d}"], "show two eyes"),
        ("frame_{:04d}", ["depth_{:04d}"], "left out: 6 depth picture"),
        ("{:04d}", ["{:04d}_disp", "{:04d}-label"], "left out: 6 label picture"),
        ("image_{:02d}", ["label_{:02d}", "depth_{:02d}"], "left out: 6 depth picture"),
        ("frame{:02d}", ["frame{:02d}_segmentation"], "left out: 6 label picture"),
        ("{:04d}_color", ["{:04d}_ir"], "left out: 6 pictures of another series"),
        ("rgb_{:04d}", ["nbi_{:04d}"], "left out: 6 pictures of another series"),
        ("left_{:02d}", ["right_{:02d}", "depth_{:02d}", "mask_{:02d}"], "show two eyes"),
    ],
)
def test_only_frames_of_one_camera_are_used_and_the_others_named(
    used: str, others: list[str], said: str, tmp_path: Path
) -> None:
    names = [used.format(k) for k in N] + [other.format(k) for other in others for k in N]
    sequence = open_sequence(_folder(tmp_path / "images", names))
    assert [number_in(frame.rgb) for frame in sequence.frames()] == list(N)
    assert any(said in str(note) for note in sequence.notes)


@pytest.mark.parametrize(
    ("forms", "words"),
    [
        (["depth_{:04d}"], r"all 6 images are depth pictures by their names, such as depth_0000\.png; give the folder"),
        (["{:04d}_mask"], r"all 6 images are label pictures"),
        (["depth_{:02d}", "label_{:02d}"], r"all 12 images are depth and label pictures"),
        (["white_{:04d}", "nbi_{:04d}"], r"2 series with the same numbers \(6 like white_0000\.png, 6 like nbi_0000"),
        (["{:04d}_a", "{:04d}_b"], r"2 series with the same numbers"),
        (["cam0_{:04d}", "cam1_{:04d}"], r"2 series with the same numbers"),
    ],
)
def test_what_is_not_known_to_be_one_camera_is_refused(forms: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        open_sequence(_folder(tmp_path / "images", [form.format(k) for form in forms for k in N]))


def test_a_stray_picture_is_not_the_folder(tmp_path: Path) -> None:
    assert open_sequence(_folder(tmp_path / "gt", [*(f"gt_{k:03d}" for k in range(12)), "overview"])).count == 12
    with pytest.raises(InputError, match="label pictures by their names"):
        open_sequence(_folder(tmp_path / "masks", [*(f"mask_{k:03d}" for k in range(12)), "overview"]))


def test_a_stray_picture_without_a_number_is_no_frame(tmp_path: Path) -> None:
    """A cover was the last frame, and all frames lost their numbers, by which masks and depth files are found."""
    source = ImageFolder(_folder(tmp_path / "images", [*(f"{number:04d}" for number in range(5, 15)), "cover"]))
    assert (source.numbers, _shown(source)) == (list(range(5, 15)), list(range(10)))
    assert any(
        note.startswith("left out: 1 picture(s) without a number") and "cover.png" in note for note in source.notes
    )


def test_the_first_of_renamed_pictures_may_have_no_number(tmp_path: Path) -> None:
    names = ["image", *(f"image ({number})" for number in range(1, 10))]
    assert _shown(ImageFolder(_folder(tmp_path / "images", names))) == list(range(10))


def test_two_counters_of_two_digits_are_no_times(tmp_path: Path) -> None:
    names = [f"scan_{a}.{b:02d}" for a in range(3) for b in range(1, 15)]
    assert not ImageFolder(_folder(tmp_path / "images", names)).stamped


@pytest.mark.parametrize("names", [["a_{}", "b_1{}"], ["normal_colon_{}"], ["seg_{}"], ["12_30_4{}_001"]])
def test_other_words_leave_nothing_out(names: list[str], tmp_path: Path) -> None:
    source = ImageFolder(_folder(tmp_path / "images", [name.format(k) for name in names for k in N]))
    assert source.count == len(names) * len(N)
    assert not any("left out" in str(note) for note in source.notes)


def test_numbers_that_repeat_are_told(tmp_path: Path) -> None:
    source = ImageFolder(_folder(tmp_path / "images", [f"part{part}_{k:03d}" for part in (1, 2) for k in N]))
    assert source.numbers == list(range(12))
    assert "part1_000.png and part2_000.png have the same number" in str(source.warnings[0])


@pytest.mark.parametrize(("bits", "ending"), [(10, "png"), (12, "png"), (12, "tif"), (14, "png"), (16, "png")])
def test_levels_of_fewer_bits_than_16_fill_the_range(bits: int, ending: str, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    pictures = [picture(number, SIZE) for number in range(5)]
    for number, rgb in enumerate(pictures):
        levels = rgb.astype(np.uint16) << (bits - 8)
        levels[0, 0] = (1 << bits) - 1
        assert cv2.imwrite(str(folder / f"{number:03d}.{ending}"), levels[..., ::-1])
    source = ImageFolder(folder)
    for frame, rgb in zip(source.frames(slice(None)), pictures, strict=True):
        np.testing.assert_allclose(frame.rgb[1:].astype(int), rgb[1:], atol=1)
    said = [str(note) for note in source.notes if "bits" in str(note)]
    expected = [f"levels: 16-bit pictures hold {bits} bits, which are scaled to the whole range"]
    assert said == (expected if bits < 16 else [])


def test_transparency_has_no_say_in_the_bits_of_a_picture(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(5):
        levels = picture(number, SIZE).astype(np.uint16) << 4
        opaque = np.dstack([levels[..., ::-1], np.full(levels.shape[:2], 65535, np.uint16)])
        assert cv2.imwrite(str(folder / f"{number:03d}.png"), opaque)
    assert any("16-bit pictures hold 12 bits" in str(note) for note in ImageFolder(folder).notes)


def test_of_many_pictures_few_are_read_for_their_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, read = tmp_path / "images", list[Path]()
    folder.mkdir()
    for number in range(64):
        assert cv2.imwrite(str(folder / f"{number:03d}.png"), np.full((8, 8, 3), 1000, np.uint16))

    def counted(file: Path, *flags: int) -> np.ndarray | None:
        read.append(file)
        return read_decoded(file, *flags)

    monkeypatch.setattr("scopemap.input.images.read_decoded", counted)
    ImageFolder(folder)
    assert len(set(read)) == 16


def test_masks_that_differ_from_their_pictures_by_the_ending_alone_are_not_mixed_in(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "images", [f"{number:04d}" for number in range(6)])
    for number in range(6):
        save(folder / f"{number:04d}.jpg", picture(number, SIZE))
    with pytest.raises(InputError, match=r"2 series with the same numbers \(6 like 0000\.(jpg|png)"):
        ImageFolder(folder)
    for number in range(6):  # one video, of which a part was saved otherwise
        (folder / f"{number:04d}.jpg").rename(folder / f"{number + 6:04d}.jpg")
    assert len(list(ImageFolder(folder).frames(slice(None)))) == 12
