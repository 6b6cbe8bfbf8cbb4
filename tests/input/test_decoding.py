"""Images that claim to be larger than they may be are refused before they are decoded; damaged ones are none."""

from __future__ import annotations

import resource
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.input.decoding import decoded, read_decoded, stated_size

HUGE = 60_000


def encoded(ending: str, image: np.ndarray) -> bytes:
    ok, content = cv2.imencode(ending, image)
    assert ok
    return content.tobytes()


def grey(dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 200, (12, 20)).astype(dtype)


def huge(ending: str) -> bytes:
    content = bytearray(encoded(ending, grey()))
    if ending == ".png":
        content[16:24] = struct.pack(">II", HUGE, HUGE)
        content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
        return bytes(content)
    if ending == ".jpg":
        start = content.index(b"\xff\xc0")
        content[start + 5 : start + 9] = struct.pack(">HH", HUGE, HUGE)
        return bytes(content)
    if ending == ".bmp":
        content[18:26] = struct.pack("<ii", HUGE, HUGE)
        return bytes(content)
    (place,) = struct.unpack("<I", content[4:8])
    (count,) = struct.unpack("<H", content[place : place + 2])
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind = struct.unpack("<HH", content[entry : entry + 4])
        if tag in (256, 257):
            content[entry + 8 : entry + 12] = struct.pack("<HH" if kind == 3 else "<I", *([HUGE, 0][: 5 - kind]))
    return bytes(content)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".tiff"])
def test_what_claims_to_be_huge_is_refused(ending: str, tmp_path: Path) -> None:
    content = huge(ending)
    with pytest.raises(InputError, match=r"more than 64 million pixels.*SCOPEMAP_MAX_MEGAPIXELS"):
        decoded(content)
    (tmp_path / "bömb 1.png").write_bytes(content)
    with pytest.raises(InputError, match=r"reading .*bömb 1\.png"):
        read_decoded(tmp_path / "bömb 1.png")


@pytest.mark.parametrize(
    ("ending", "dtype"),
    [(".png", np.uint8), (".png", np.uint16), (".bmp", np.uint8), (".tiff", np.uint16), (".tiff", np.float32)],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_sound_images_come_as_they_were(ending: str, dtype: type, channels: int) -> None:
    image = grey(dtype) if channels == 1 else np.repeat(grey(dtype)[..., None], 3, -1)
    if ending == ".bmp" and channels == 1:
        assert decoded(encoded(ending, image), cv2.IMREAD_GRAYSCALE) is not None
        return
    np.testing.assert_array_equal(decoded(encoded(ending, image)), image)


@pytest.mark.parametrize("content", [b"", b"nothing", b"II*\0", encoded(".png", grey())[:30], b"II*\0" + b"\xff" * 80])
def test_what_is_no_image_is_none(content: bytes) -> None:
    assert decoded(content) is None


def test_the_limit_can_be_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_MAX_MEGAPIXELS", "0.0001")
    with pytest.raises(InputError, match=r"more than 0\.0001 million"):
        decoded(encoded(".png", grey()))
    monkeypatch.setenv("SCOPEMAP_MAX_MEGAPIXELS", "many")
    with pytest.raises(InputError, match="must be a number, got 'many'"):
        decoded(encoded(".png", grey()))


def test_a_chunk_that_claims_gigabytes_takes_no_memory() -> None:
    """A PNG of 100 kB, of which a length is damaged."""
    sound = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (200, 200, 3), np.uint8))[1].tobytes()
    at = sound.index(b"IDAT")
    damaged = sound[: at - 4] + b"\xf0" + sound[at - 3 :]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert decoded(damaged) is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000, "kB of memory"
    assert decoded(sound) is not None


def _turned_png(place: str) -> bytes:
    """A PNG of 12x20 px that is to be shown turned by a quarter, as its chunk before or behind the picture says."""
    plain = encoded(".png", grey())
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)  # one entry: orientation 6
    kind, body = {
        "before": (b"eXIf", tiff),
        "behind": (b"eXIf", tiff),
        "xmp": (b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + b'<x tiff:Orientation="6"/>'),
    }[place]
    chunk = struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    at = plain.index(b"IEND") - 4 if place == "behind" else plain.index(b"IDAT") - 4
    return plain[:at] + chunk + plain[at:]


@pytest.mark.parametrize("place", ["before", "behind", "xmp"])
def test_the_size_of_a_png_is_that_to_be_shown_wherever_it_is_stated(place: str, tmp_path: Path) -> None:
    (tmp_path / "plain.png").write_bytes(encoded(".png", grey()))
    (tmp_path / "turned.png").write_bytes(_turned_png(place))
    assert stated_size(tmp_path / "plain.png") == (12, 20)
    assert stated_size(tmp_path / "turned.png") == (20, 12)


def test_the_size_of_a_png_is_known_without_its_picture(tmp_path: Path) -> None:
    content = encoded(".png", grey())
    start = content.index(b"IDAT") + 4
    (tmp_path / "damaged.png").write_bytes(content[:start] + bytes(len(content) - start))
    assert stated_size(tmp_path / "damaged.png") == (12, 20)
