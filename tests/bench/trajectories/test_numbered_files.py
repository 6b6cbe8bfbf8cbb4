"""Numbered files in folders and archives: read in place, within bounds, whatever the archive holds."""

from __future__ import annotations

import gzip
import io
import tarfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap_bench.trajectories import numbered
from scopemap_bench.trajectories.numbered import NumberedFiles, find_numbered
from tests.support.drawn_scared import Files, write_loose, write_tar

MB = 1 << 20


def noise(seed: int, size: int) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def members(count: int, size: int = 1000) -> Files:
    return {f"point{number:04d}.bin": noise(number, size) for number in range(count)}


def find(folder: Path) -> NumberedFiles:
    found = find_numbered(folder, ("points",), "point", (".bin",))
    assert found is not None
    return found


# ---- places


@pytest.mark.parametrize("form", ["folder", ".tar.gz", ".tar"])
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
    assert all(found.read(number) == noise(number, 1000) for number in range(12))


def test_an_archive_in_any_order_is_read_by_number(tmp_path: Path) -> None:
    files = members(9)
    order = [3, 0, 8, 1, 7, 2, 6, 5, 4]
    write_tar(tmp_path / "points.tar.gz", {f"point{n:04d}.bin": files[f"point{n:04d}.bin"] for n in order})
    found = find(tmp_path)
    assert [found.read(n) for n in range(9)] == list(files.values())
    assert found.numbers() == list(range(9))
    # Read in its own order, an archive is decompressed once.
    assert find(tmp_path).stored() == order


@pytest.mark.parametrize("first", ["nothing", "numbers"])
@pytest.mark.parametrize("order", ["ascending", "descending", "shuffled"])
def test_an_archive_is_decompressed_once_whatever_its_order(
    order: str, first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = members(30, 5000)
    names = {"ascending": list(files), "descending": list(files)[::-1]}.get(order)
    names = names or [list(files)[n] for n in np.random.default_rng(0).permutation(30)]
    write_tar(tmp_path / "points.tar.gz", {name: files[name] for name in names})
    rewinds = []
    rewind = gzip._GzipReader._rewind  # type: ignore[attr-defined]
    monkeypatch.setattr(gzip._GzipReader, "_rewind", lambda self: (rewinds.append(1), rewind(self)))  # type: ignore[attr-defined]
    found = find(tmp_path)
    if first == "numbers":
        assert found.numbers() == list(range(30))
    for passes in (1, 2):
        assert [found.read(n) for n in range(30)] == list(files.values())
        # Once more for each time that it is read, and for the headers.
        assert len(rewinds) <= passes - 1 + (first == "numbers") + 1
    assert [file.name for file in tmp_path.iterdir()] == ["points.tar.gz"]


def test_frames_that_are_left_out_do_not_wait_anywhere(tmp_path: Path) -> None:
    write_tar(tmp_path / "points.tar.gz", members(40))
    found = find(tmp_path)
    assert all(found.read(n) for n in range(0, 40, 10))
    assert found._spool is None  # type: ignore[union-attr]


def test_reading_keeps_nothing_in_memory_and_writes_nothing(tmp_path: Path) -> None:
    write_tar(tmp_path / "points.tar.gz", members(32, MB // 4))
    found = find(tmp_path)
    tracemalloc.start()
    assert all(found.read(number) == noise(number, MB // 4) for number in range(32))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * MB
    assert [file.name for file in tmp_path.iterdir()] == ["points.tar.gz"]


# ---- what is wrong with archives


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbered, "LARGEST_FILE_BYTES", MB)
    write_tar(tmp_path / "points.tar.gz", {"point1.bin": bytes(9 * MB)})
    with pytest.raises(InputError, match=r"points\.tar\.gz, point1\.bin: it holds 9 MB, expected 1 MB at most"):
        find(tmp_path).read(1)
    write_loose(tmp_path / "points", {"point1.bin": bytes(2 * MB)})
    with pytest.raises(InputError, match=r"point1\.bin: it holds 2 MB"):
        find(tmp_path).read(1)


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


@pytest.mark.parametrize("kept", [0.02, 0.9])
def test_an_archive_that_breaks_off_is_reported(kept: float, tmp_path: Path) -> None:
    file = write_tar(tmp_path / "points.tar.gz", members(100))
    data = file.read_bytes()
    file.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"points\.tar.*: the archive is damaged or incomplete") as caught:
        find(tmp_path).numbers()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"no gzip at all", gzip.compress(b"no tar", mtime=0), gzip.compress(bytes(100), mtime=0)]
)
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


# ---- headers without limit


@pytest.mark.slow
def test_a_long_name_that_grows_is_refused(tmp_path: Path) -> None:
    """200 kB of archive that would become a name of 200 MB."""
    member = tarfile.TarInfo("././@LongLink")
    member.type, member.size = tarfile.GNUTYPE_LONGNAME, 200 * MB
    with gzip.open(tmp_path / "points.tar.gz", "wb") as file:
        file.write(member.tobuf())
        for _ in range(200):
            file.write(bytes(MB))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"points\.tar\.gz.*a header claims 209715200 bytes"):
        find(tmp_path).numbers()
    assert tracemalloc.get_traced_memory()[1] < 20 * MB
    tracemalloc.stop()


def test_an_archive_of_empty_members_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbered, "_MOST_MEMBERS", 50)
    write_tar(tmp_path / "points.tar.gz", members(50, 0))
    assert find(tmp_path).numbers() == list(range(50))
    write_tar(tmp_path / "points.tar.gz", members(51, 0))
    with pytest.raises(InputError, match="more than 50 members"):
        find(tmp_path).numbers()
