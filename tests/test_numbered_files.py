"""Numbered files in folders and archives: read in place, within bounds, whatever the archive holds."""

from __future__ import annotations

import gzip
import io
import tarfile
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from drawn_scared import Files, write_loose, write_tar
from hypothesis import given
from hypothesis import strategies as st

from scopemap.errors import InputError
from scopemap.io.datasets import numbered, seekable_gzip
from scopemap.io.datasets.numbered import NumberedFiles, find_numbered
from scopemap.io.datasets.seekable_gzip import SeekableGzip

MB = 1 << 20


def noise(seed: int, size: int) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def members(count: int, size: int = 1000) -> Files:
    return {f"point{number:04d}.bin": noise(number, size) for number in range(count)}


def find(folder: Path) -> NumberedFiles:
    found = find_numbered(folder, ("points",), "point", (".bin",))
    assert found is not None
    return found


class Counter:
    """Counts the bytes that are decompressed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bytes = 0
        original = SeekableGzip._decompressed

        def counted(stream: SeekableGzip, most: int) -> bytes:
            data = original(stream, most)
            self.bytes += len(data)
            return data

        monkeypatch.setattr(SeekableGzip, "_decompressed", counted)


# ---- places


@pytest.mark.parametrize("form", ["folder", ".tar.gz", ".tgz", ".tar"])
def test_folder_and_archives_read_alike(form: str, tmp_path: Path) -> None:
    files = members(12) | {"notes.txt": b"none", "point.bin": b"no number", "point3.txt": b"another kind"}
    if form == "folder":
        write_loose(tmp_path / "points", files)
    else:
        write_tar(tmp_path / f"points{form}", {f"./deep/{name}": data for name, data in files.items()})
    found = find(tmp_path)
    assert found.read(7) == noise(7, 1000)
    assert found.read(2) == noise(2, 1000)
    assert found.read(12) is None
    assert found.numbers() == list(range(12))
    assert [(name, number) for name, number, _ in found] == [(f"point{n:04d}.bin", n) for n in range(12)]
    assert all(content == noise(number, 1000) for _, number, content in found)


def test_nothing_is_found_where_nothing_is(tmp_path: Path) -> None:
    write_loose(tmp_path / "points", {"other.bin": b""})
    assert find_numbered(tmp_path, ("points", "elsewhere"), "point", (".bin",)) is None


def test_an_archive_in_any_order_is_read_by_number(tmp_path: Path) -> None:
    files = members(9)
    order = [3, 0, 8, 1, 7, 2, 6, 5, 4]
    write_tar(tmp_path / "points.tar.gz", {f"point{n:04d}.bin": files[f"point{n:04d}.bin"] for n in order})
    found = find(tmp_path)
    assert [found.read(n) for n in range(9)] == list(files.values())
    assert found.numbers() == list(range(9))


# ---- bounds


def test_reading_on_decompresses_everything_once_and_keeps_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tar(tmp_path / "points.tar.gz", members(16, MB))
    counter = Counter(monkeypatch)
    found = find(tmp_path)
    tracemalloc.start()
    assert all(found.read(number) == noise(number, MB) for number in range(16))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert counter.bytes <= 17 * MB
    assert peak < 8 * MB
    assert [file.name for file in tmp_path.iterdir()] == ["points.tar.gz"]


def test_only_what_lies_before_the_wanted_file_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_tar(tmp_path / "points.tar.gz", members(16, MB // 4))
    counter = Counter(monkeypatch)
    found = find(tmp_path)
    assert counter.bytes == 0, "nothing is read before it is asked for"
    found.read(3)
    assert counter.bytes <= 2.5 * MB


def test_going_back_costs_one_stretch_between_restart_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seekable_gzip, "SPACING_BYTES", 2 * MB)
    write_tar(tmp_path / "points.tar.gz", members(16, MB))
    counter = Counter(monkeypatch)
    found = find(tmp_path)
    found.numbers()
    for number in (13, 2, 9):
        counter.bytes = 0
        assert found.read(number) == noise(number, MB)
        assert counter.bytes <= 6 * MB


def test_restart_points_are_thinned_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seekable_gzip, "SPACING_BYTES", 100_000)
    monkeypatch.setattr(seekable_gzip, "MOST_POINTS", 8)
    content = noise(0, 6 * MB)
    (tmp_path / "a.gz").write_bytes(gzip.compress(content, 1))
    stream = SeekableGzip(tmp_path / "a.gz")
    assert io.BufferedReader(stream).read() == content
    stream = SeekableGzip(tmp_path / "a.gz")
    while stream.read(MB):
        assert len(stream._points) <= 8
    assert len(stream._points) >= 4
    for position in (5 * MB, 2 * MB + 7, 0):
        stream.seek(position)
        assert stream.read(50) == content[position : position + 50]


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 300)), max_size=20))
def test_seeking_is_as_in_the_plain_content(
    tmp_path_factory: pytest.TempPathFactory, moves: list[tuple[int, int]]
) -> None:
    content = noise(1, 2000) + bytes(2000) + noise(2, 500)
    folder = tmp_path_factory.getbasetemp()
    # Two streams one after the other, and zeros that fill the file up.
    (folder / "a.gz").write_bytes(gzip.compress(content[:1500]) + gzip.compress(content[1500:]) + bytes(40))
    stream = io.BufferedReader(SeekableGzip(folder / "a.gz"), 64)
    plain = io.BytesIO(content)
    for position, count in moves:
        stream.seek(position)
        plain.seek(position)
        assert stream.read(count) == plain.read(count)


# ---- what is wrong with archives


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbered, "LARGEST_FILE_BYTES", MB)
    write_tar(tmp_path / "points.tar.gz", {"point1.bin": bytes(9 * MB)})
    counter = Counter(monkeypatch)
    with pytest.raises(InputError, match=r"points\.tar\.gz, point1\.bin: it holds 9 MB, expected 1 MB at most"):
        find(tmp_path).read(1)
    assert counter.bytes <= 2 * MB
    write_loose(tmp_path / "points", {"point1.bin": bytes(2 * MB)})
    with pytest.raises(InputError, match=r"point1\.bin: it holds 2 MB"):
        find(tmp_path).read(1)


def test_an_archive_of_endless_small_files_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbered, "MOST_MEMBERS", 20)
    write_tar(tmp_path / "points.tar.gz", members(30, 1))
    with pytest.raises(InputError, match="holds more than 20 files"):
        find(tmp_path).numbers()


def test_links_and_paths_that_lead_outside_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "secret7.bin").write_bytes(b"secret")
    with tarfile.open(tmp_path / "points.tar", "w") as archive:
        for name, kind in (
            ("point7.bin", tarfile.SYMTYPE),
            ("point8.bin", tarfile.LNKTYPE),
            ("point9.bin", tarfile.CHRTYPE),
        ):
            link = tarfile.TarInfo(name)
            link.type, link.linkname = kind, "secret7.bin"
            archive.addfile(link)
        outside = tarfile.TarInfo("../../point10.bin")
        outside.size = 4
        archive.addfile(outside, io.BytesIO(b"data"))
    before = sorted(tmp_path.parent.rglob("*"))
    found = find(tmp_path)
    assert found.numbers() == [10]
    assert found.read(10) == b"data"
    assert sorted(tmp_path.parent.rglob("*")) == before


@pytest.mark.parametrize("kept", [0.02, 0.5, 0.97])
def test_an_archive_that_breaks_off_is_said(kept: float, tmp_path: Path) -> None:
    file = write_tar(tmp_path / "points.tar.gz", members(10))
    data = file.read_bytes()
    file.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"points\.tar\.gz: the archive is damaged or incomplete") as caught:
        find(tmp_path).numbers()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no gzip at all", gzip.compress(b"no tar"), gzip.compress(bytes(100))])
def test_what_is_no_archive_is_said(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "points.tar.gz").write_bytes(content)
    with pytest.raises(InputError, match="damaged or incomplete"):
        find(tmp_path).read(0)


def test_headers_that_lead_back_are_not_read_for_ever(tmp_path: Path) -> None:
    """A negative size makes a reader of archives go back to where it was (CVE-2025-8194)."""
    file = write_tar(tmp_path / "points.tar", members(3))
    data = bytearray(file.read_bytes())
    second = 512 + 1024
    data[second + 124 : second + 136] = b"\xff" * 8 + (-2048).to_bytes(4, "big", signed=True)
    data[second + 148 : second + 156] = b" " * 8
    data[second + 148 : second + 156] = b"%06o\0 " % sum(data[second : second + 512])
    file.write_bytes(data)
    with pytest.raises(InputError, match="damaged or incomplete"):
        find(tmp_path).numbers()


def test_any_damage_ends_in_one_kind_of_error(tmp_path: Path) -> None:
    """300 mutated archives: bytes changed in the tar or in the gzip around it."""
    plain = write_tar(tmp_path / "source.tar", members(4, 200)).read_bytes()
    rng = np.random.default_rng(0)
    file = tmp_path / "points.tar.gz"
    refused = 0
    for trial in range(300):
        data = bytearray(plain if trial % 2 else gzip.compress(plain, 1))
        for position in rng.integers(0, len(data), rng.integers(1, 5)):
            data[position] = rng.integers(256)
        file.write_bytes(zlib.compress(data, 1, 31) if trial % 2 else bytes(data))
        try:
            assert len(list(find(tmp_path))) <= 4
        except InputError:
            refused += 1
    assert 30 < refused < 300
