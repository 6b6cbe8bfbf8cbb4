"""DICOM: which pixels, which times, whose names; and what damaged files end in."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pydicom
import pytest
from PIL import Image
from pydicom.pixels.encoders import RLELosslessEncoder
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
    JPEGLosslessSV1,
    RLELossless,
)

from scopemap.engine.errors import InputError
from scopemap.engine.notices import Notice
from scopemap.input.datasets.dicom import Dicom
from scopemap.input.opening import open_sequence
from tests.support.drawn_dicom import (
    PATIENT,
    SIZE,
    film,
    h264,
    jpeg,
    native,
    packed,
    save,
    write_dicom_video,
    write_frames,
)
from tests.support.drawn_inputs import number_in, picture

YBR = {"PhotometricInterpretation": "YBR_FULL"}
GREY = {"SamplesPerPixel": 1, "PhotometricInterpretation": "MONOCHROME2", "PlanarConfiguration": None}


def pictures(file: Path) -> np.ndarray:
    return np.stack([frame.rgb for frame in Dicom(file).frames(slice(None))])


def as_ybr(rgb: np.ndarray) -> np.ndarray:
    return np.stack([cv2.cvtColor(one, cv2.COLOR_RGB2YCrCb)[..., [0, 2, 1]] for one in rgb])


def halved(rgb: np.ndarray) -> np.ndarray:
    """YBR_FULL_422: Y Y B R of two neighbours."""
    ybr = as_ybr(rgb)
    y, b, r = (ybr[..., channel] for channel in range(3))
    return np.stack([y[..., ::2], y[..., 1::2], b[..., ::2], r[..., ::2]], -1)


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
def test_native_pictures_come_out_as_they_are(tmp_path: Path, syntax: str) -> None:
    file = native(tmp_path / "a.dcm", film(), syntax, PixelAspectRatio=[10, 11])
    np.testing.assert_array_equal(pictures(file), film())
    assert Dicom(file).pixel_aspect == pytest.approx(1.1)
    apart = np.moveaxis(film(), -1, 1)
    np.testing.assert_array_equal(pictures(native(tmp_path / "b.dcm", apart, PlanarConfiguration=1)), film())


def test_colours_may_be_brightness_and_differences(tmp_path: Path) -> None:
    whole = pictures(native(tmp_path / "a.dcm", as_ybr(film()), **YBR))
    assert np.abs(whole.astype(int) - film()).max() <= 2
    even = film().copy()
    even[..., 1::2, :] = even[..., ::2, :]
    half = pictures(native(tmp_path / "b.dcm", halved(even), PhotometricInterpretation="YBR_FULL_422"))
    assert np.abs(half.astype(int) - even).max() <= 2


@pytest.mark.parametrize(
    ("values", "tags", "level"),
    [
        (np.full((2, 48, 64), 77, np.uint8), {}, 77),
        (np.full((2, 48, 64), 77, np.uint8), {"PhotometricInterpretation": "MONOCHROME1"}, 178),
        (np.full((2, 48, 64), 77 << 4, np.uint16), {"BitsAllocated": 16, "BitsStored": 12, "HighBit": 11}, 77),
        (
            np.full((2, 48, 64), -512, np.int16),
            {"BitsAllocated": 16, "BitsStored": 12, "HighBit": 11, "PixelRepresentation": 1},
            (2048 - 512) >> 4,
        ),
    ],
)
def test_grey_of_any_depth(tmp_path: Path, values: np.ndarray, tags: dict[str, Any], level: int) -> None:
    assert (pictures(native(tmp_path / "a.dcm", values, **GREY | tags)) == level).all()


def test_grey_levels_are_those_that_the_file_wants_shown(tmp_path: Path) -> None:
    bits = {"BitsAllocated": 16, "BitsStored": 12, "HighBit": 11}
    values = np.full((2, 48, 64), 400, np.uint16)
    values[:, :24] = 40
    dark = native(tmp_path / "a.dcm", values, **GREY, **bits)
    assert pictures(dark).max() == 25
    assert any("all 12 stored bits" in note for note in Dicom(dark).notes)
    window = native(tmp_path / "b.dcm", values, **GREY, **bits, WindowCenter=[300, 1], WindowWidth=[401, 1])
    assert sorted(set(pictures(window).ravel())) == [0, round(255 * (400 - 99.5) / 400)]
    assert any("the window of the file (WindowCenter" in note for note in Dicom(window).notes)
    scaled = {"RescaleSlope": 2, "RescaleIntercept": -10, "WindowCenter": 400, "WindowWidth": 801}
    assert pictures(native(tmp_path / "c.dcm", values, **GREY, **bits, **scaled)).max() == round(255 * 790.5 / 800)
    whole = np.arange(2 * 48 * 64).astype(np.uint8).reshape(2, 48, 64)
    file = native(tmp_path / "d.dcm", whole, **GREY, WindowCenter=128, WindowWidth=256)
    np.testing.assert_array_equal(pictures(file)[..., 0], whole)


def test_a_palette_is_looked_up(tmp_path: Path) -> None:
    tags = GREY | {"PhotometricInterpretation": "PALETTE COLOR"}
    for colour, level in zip(("Red", "Green", "Blue"), (10, 120, 250), strict=True):
        tags[f"{colour}PaletteColorLookupTableDescriptor"] = [4, 0, 16]
        tags[f"{colour}PaletteColorLookupTableData"] = np.array([0, 0, level << 8, 0], "<u2").tobytes()
    rgb = pictures(native(tmp_path / "a.dcm", np.full((2, 48, 64), 2, np.uint8), **tags))
    np.testing.assert_allclose(rgb, np.broadcast_to((10, 120, 250), rgb.shape), atol=1)


def test_packed_pictures(tmp_path: Path) -> None:
    close = pictures(write_frames(tmp_path / "a"))
    assert np.abs(close.astype(int) - film()).mean() < 4
    options = {"rows": SIZE[1], "columns": SIZE[0], "samples_per_pixel": 3, "number_of_frames": 1}
    options |= {"bits_allocated": 8, "bits_stored": 8, "pixel_representation": 0, "planar_configuration": 0}
    options |= {"photometric_interpretation": "RGB"}
    runs = [RLELosslessEncoder.encode(one.tobytes(), **options) for one in film()]
    np.testing.assert_array_equal(pictures(packed(tmp_path / "b.dcm", runs, RLELossless)), film())
    wavelets = []
    for one in film():
        stream = io.BytesIO()
        Image.fromarray(one).save(stream, "JPEG2000", irreversible=False, no_jp2=True)
        wavelets.append(stream.getvalue())
    file = packed(tmp_path / "c.dcm", wavelets, JPEG2000Lossless, PhotometricInterpretation="YBR_RCT")
    np.testing.assert_array_equal(pictures(file), film())


@pytest.mark.parametrize("pieces", [1, 4])
def test_a_video_is_decoded_in_place(tmp_path: Path, pieces: int) -> None:
    sequence = open_sequence(write_dicom_video(tmp_path / "a", pieces), frames=slice(1, None))
    frames = list(sequence.source.frames(slice(1, None)))
    assert [number_in(frame.rgb) for frame in frames] == [1, 2, 3, 4, 5]
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(1, 6) / 25)
    assert list(tmp_path.rglob("*.mp4")) == []


needs_h264 = pytest.mark.skipif("libx264" not in av.codecs_available, reason="no encoder for H.264")


@needs_h264
@pytest.mark.parametrize("container", ["mp4", "h264"])
def test_h264_is_decoded_and_its_own_times_beat_rounded_ones(tmp_path: Path, container: str) -> None:
    file = write_dicom_video(tmp_path, content=h264(container), FrameTime=33, CineRate=30, NumberOfFrames=30)
    source = Dicom(file)
    frames = list(source.frames(slice(None)))
    assert [number_in(frame.rgb) for frame in frames] == list(range(30))
    # A bare stream holds no stamps: then the header's rate is used.
    step_s = 0.033 if container == "h264" else 1 / 30
    np.testing.assert_allclose(np.diff([frame.time_s for frame in frames]), step_s, atol=1e-4)
    assert source.warnings == []


def test_times_are_those_that_the_file_states(tmp_path: Path) -> None:
    def times(**tags: Any) -> list[float]:
        return [time_s for _, time_s in Dicom(native(tmp_path / "a.dcm", film(), **tags)).stamps(slice(None)) or []]

    np.testing.assert_allclose(times(FrameTimeVector=[0, 40, 20, 30], FrameTime=1), [0, 0.04, 0.06, 0.09])
    np.testing.assert_allclose(times(FrameTime=20, CineRate=25), np.arange(4) / 50)
    np.testing.assert_allclose(times(CineRate=25), np.arange(4) / 25)
    np.testing.assert_allclose(times(RecommendedDisplayFrameRate=10), np.arange(4) / 10)
    np.testing.assert_allclose(times(FrameTimeVector=[0, 40, 0, 30], FrameTime=0), np.arange(4) / 30)


def write_series(folder: Path, instances: list[int | None], series: str = "1.2.3") -> Path:
    for place, (number, rgb) in enumerate(zip(instances, film(len(instances)), strict=True)):
        tags = {"SeriesInstanceUID": series, "InstanceNumber": number, "NumberOfFrames": None}
        native(folder / f"{PATIENT}{place}", rgb[None], **tags)
    return folder


def test_a_series_is_sorted_by_its_numbers(tmp_path: Path) -> None:
    source = open_sequence(write_series(tmp_path / "a", [12, 3, 10, 2])).source
    assert isinstance(source, Dicom)
    frames = list(source.frames(slice(None)))
    assert [frame.index for frame in frames] == [2, 3, 10, 12]
    assert [number_in(frame.rgb) for frame in frames] == [3, 1, 2, 0]
    assert [frame.name for frame in frames] == ["2", "3", "10", "12"]


def test_no_word_about_the_patient_comes_out(tmp_path: Path) -> None:
    files = [
        write_frames(tmp_path / "a"),
        write_dicom_video(tmp_path / "b"),
        write_series(tmp_path / "c", [1, 1, None, 4]),
        native(tmp_path / "d.dcm", film(), BurnedInAnnotation="YES"),
    ]
    for path in files:
        sequence = open_sequence(path)
        told = [*map(str, [*sequence.notes, *sequence.warnings]), sequence.camera_source, sequence.name]
        told += [frame.name for frame in sequence.frames()]
        assert told
        assert not any(word in text for text in told for word in ("Muster", "Erika", "4711", "1.2.3"))
    assert Notice("input-text-burned-in") in Dicom(files[-1]).warnings


# ---- faults


def test_a_file_that_breaks_off_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    for number, file in enumerate((native(tmp_path / "a.dcm", film()), write_frames(tmp_path / "b"))):
        content = file.read_bytes()
        file.write_bytes(content[: -int(1.5 * (SIZE[0] * SIZE[1] * 3 if number == 0 else 1000))])
        source = Dicom(file)
        read = [number_in(frame.rgb) for frame in source.frames(slice(None))]
        assert 2 <= len(read) < 4
        assert read == list(range(len(read)))
        assert any("these were used" in w or "was left out" in w for w in source.warnings)


def test_a_picture_that_cannot_be_decoded_is_left_out_and_keeps_its_number(tmp_path: Path) -> None:
    frames = [jpeg(rgb) for rgb in film()]
    frames[1] = frames[1][:250]
    frames[3] = jpeg(picture(1, (640, 480)))
    source = Dicom(packed(tmp_path / "a.dcm", frames, JPEGBaseline8Bit, PhotometricInterpretation="YBR_PARTIAL_420"))
    assert [frame.index for frame in source.frames(slice(None))] == [0, 2]
    assert source.warnings == [f"image {number} cannot be decoded and was left out" for number in (1, 3)]


def test_claims_take_no_memory(tmp_path: Path) -> None:
    file = native(tmp_path / "a.dcm", film(), Rows=60_000, Columns=60_000)
    with pytest.raises(InputError, match="more than 64 million pixels"):
        open_sequence(file)
    many = native(tmp_path / "b.dcm", film())
    content = many.read_bytes()
    claimed = struct.pack("<HH2sH", 0x28, 8, b"IS", 2) + b"4 "
    assert claimed in content
    many.write_bytes(content.replace(claimed, struct.pack("<HH2sH", 0x28, 8, b"IS", 10) + b"2000000000"))
    source = Dicom(many)
    assert source.count == 4
    assert source.warnings == ["the file states 2000000000 images and holds 4; these were used"]


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    lossless = packed(tmp_path / "a.dcm", [jpeg(film()[0])] * 2, JPEGLosslessSV1)
    with pytest.raises(InputError, match=r"no decoder is installed for JPEG Lossless.* or convert the file"):
        open_sequence(lossless)
    lossless.write_bytes(lossless.read_bytes().replace(b"1.2.840.10008.1.2.4.70", b"1.2.4711.1950.1950.195"))
    with pytest.raises(InputError, match="for an unknown transfer syntax") as caught:
        open_sequence(lossless)
    assert "4711" not in str(caught.value)
    with pytest.raises(InputError, match="holds no images"):
        open_sequence(native(tmp_path / "b.dcm", film(), DeflatedExplicitVRLittleEndian))
    for tags in ({"PhotometricInterpretation": "MUSTER ERIKA"}, {"BitsAllocated": 1}):
        sequence = open_sequence(native(tmp_path / "c.dcm", film(), **tags))
        with pytest.raises(InputError, match=r"0 readable frame\(s\)"):
            list(sequence)
        assert not any("MUSTER" in warning for warning in sequence.warnings)


def test_a_file_without_pictures_is_one_sentence(tmp_path: Path) -> None:
    found = pydicom.dcmread(native(tmp_path / "a.dcm", film()))
    del found.PixelData
    with pytest.raises(InputError, match="holds no images"):
        open_sequence(save(found, tmp_path / "b.dcm"))
    (tmp_path / "c.dcm").write_text("wrongly named")
    with pytest.raises(InputError, match=r"c\.dcm: the DICOM file"):
        open_sequence(tmp_path / "c.dcm")


def test_several_series_are_refused(tmp_path: Path) -> None:
    folder = write_series(tmp_path / "a", [1, 2])
    native(folder / "film", film())
    with pytest.raises(InputError, match="1 videos or multi-frame images and 1 series of single frames"):
        open_sequence(folder)
    (folder / "film").write_bytes((folder / "film").read_bytes()[:600])
    sequence = open_sequence(folder)
    assert sequence.count == 2
    assert any("1 of 3 DICOM files hold no images or cannot be read" in warning for warning in sequence.warnings)
    again = Dicom(write_series(tmp_path / "b", [1, 1, 2]))
    assert list(again.numbers) == [0, 1, 2]
    assert any("some files of the series share a number" in warning for warning in again.warnings)
    tags = {"SeriesInstanceUID": "1.2.3", "InstanceNumber": 3, "Rows": 24, "NumberOfFrames": None}
    native(tmp_path / "b" / "fourth", film(1)[:, :24], **tags)
    again = Dicom(tmp_path / "b")
    assert [frame.index for frame in again.frames(slice(None))] == [0, 1, 2]
    assert again.left_out[3].reason == "64x24 px, others are 64x48 px"
