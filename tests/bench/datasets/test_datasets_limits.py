"""What data sets claim beyond reason is refused before it takes memory; names that lead outside are not followed."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import pytest

from scopemap.engine.errors import InputError
from scopemap.input.camera_files.colmap_model import read_largest_model
from scopemap.input.opening import open_sequence
from scopemap.result.reference import reference_trajectory
from scopemap_bench.datasets import endoslam, posed_video
from scopemap_bench.datasets.endomapper_sim import read_exr_red
from scopemap_bench.datasets.endoslam import read_sheet
from scopemap_bench.datasets.survey import survey
from tests.support.drawn_image_sets import (
    ROOM,
    STAMPS,
    TUM_SIZE,
    buffer,
    replace_line,
    write_exr,
    write_tum,
    write_xlsx,
)
from tests.support.drawn_inputs import picture, save
from tests.support.drawn_video_sets import (
    FRAMES,
    archive_of,
    images_bin,
    write_endomapper,
    write_models,
    write_stereomis,
)

MODEL = "33/sparse/0/images.bin"


def write_damaged_lzma(file: Path, member: str, content: bytes) -> None:
    """Write a zip of one LZMA-compressed member whose compressed bytes are damaged from the first on."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr(member, content)
        size = archive.getinfo(member).compress_size
    start = 30 + len(member) + 4 + 5  # behind the headers of the member and of its LZMA stream
    damaged = bytearray(file.read_bytes())
    damaged[start : start + size - 9] = b"\xff" * (size - 9)
    file.write_bytes(damaged)


# ---- workbooks


def test_a_workbook_of_much_text_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_xlsx(tmp_path / "a.xlsx", [["a" * 1000] * 3])
    monkeypatch.setattr(endoslam, "_MOST_BYTES", 2000)
    with pytest.raises(InputError, match=r"a\.xlsx: it holds 0 MB, expected 0 MB at most"):
        read_sheet(file)


# ---- COLMAP's archives


def test_a_damaged_lzma_model_is_one_sentence(tmp_path: Path) -> None:
    write_damaged_lzma(tmp_path / "a.zip", MODEL, images_bin([1, 2, 3]))
    with pytest.raises(InputError, match=r"a\.zip: the archive is damaged or incomplete"):
        read_largest_model(tmp_path / "a.zip")


def test_a_model_of_too_many_images_is_refused(tmp_path: Path) -> None:
    write_models(tmp_path / "a.zip", {0: struct.pack("<Q", 1_000_001) + images_bin([1])[8:]})
    with pytest.raises(InputError, match="claims 1000001 images, expected 1000000 at most"):
        read_largest_model(tmp_path / "a.zip")


# ---- OpenEXR


def test_exr_shares_the_limit_of_other_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_exr(tmp_path / "a.exr", {"R": buffer(), "G": buffer(), "B": buffer()})
    monkeypatch.setenv("SCOPEMAP_MAX_MEGAPIXELS", "0.001")
    with pytest.raises(InputError, match=r"a\.exr: .*more than 0\.001 million pixels.*SCOPEMAP_MAX_MEGAPIXELS"):
        read_exr_red(tmp_path / "a.exr")


# ---- videos


@pytest.mark.parametrize("layout", ["stereomis", "endomapper"])
def test_a_count_of_frames_beyond_the_file_is_not_believed(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if layout == "stereomis":
        folder = write_stereomis(tmp_path / "P1")
    else:
        folder = write_endomapper(tmp_path)
        write_models(archive_of(folder), {0: images_bin([1, 2])})
    monkeypatch.setattr(posed_video, "_SMALLEST_FRAME_BYTES", 10**9)
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.count) == (layout, None)
    assert sequence.source.stamps(slice(None)) is None
    assert sequence.source.pose(0) is not None
    assert [warning for warning in sequence.warnings if f"claims {FRAMES} frames" in warning] == sequence.warnings
    assert reference_trajectory(sequence) is None
    found = survey(sequence)
    assert (found.announced, len(found.frames), found.stopped) == (None, FRAMES, "")
    assert not any("breaks off" in warning for warning in found.sequence.warnings)


# ---- lists of names


@pytest.mark.parametrize("way", ["absolute", "above"])
def test_names_that_lead_out_of_a_tum_folder_are_not_there(way: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    outside = tmp_path / "outside.png"
    save(outside, picture(1, TUM_SIZE))
    name = {"absolute": str(outside), "above": "rgb/../../outside.png"}[way]
    for file in ("rgb.txt", "depth.txt"):
        replace_line(folder / file, 4, f"{STAMPS[1]:.6f} {name}")
    sequence = open_sequence(folder)
    assert sequence.source.numbers == [0, 2, 3]
    assert any("rgb.txt: 1 of the 4 images that it names are not there" in text for text in sequence.warnings)
    assert any("depth.txt: 1 of the 3 images that it names are not there" in text for text in sequence.warnings)
