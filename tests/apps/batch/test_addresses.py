"""Videos at addresses: listed as files are, fetched when their turn comes, and known again."""

from __future__ import annotations

from pathlib import Path

import fsspec
import pytest

from scopemap.apps.batch.command import videos_of
from scopemap.engine.errors import InputError
from scopemap.input.inputs import RemoteFile, is_address, named_inputs, remote_files
from scopemap_bench.scripts.batch import CAMERA, write_videos
from tests.support.front_door import call
from tests.support.result_files import batch_rows, compared_files
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.cluster

QUICK = ["--set", "mapping.triangulate_depth=false"]


@pytest.fixture
def store() -> fsspec.AbstractFileSystem:
    """A store in this process's memory, with videos and what is none."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    for name in ("/archive/a.mp4", "/archive/deep/B.AVI", "/archive/deep/notes.txt", "/archive/.hidden/c.mp4"):
        system.pipe_file(name, name.encode())
    return system


def test_addresses_are_told_from_paths() -> None:
    assert all(map(is_address, ["s3://b/x.mp4", "memory://x", "file:///x", "simplecache::s3://b/x"]))
    assert not any(map(is_address, ["C://x.mp4", "C:\\x.mp4", "a/b.mp4", "x:y.mp4", "//host/share"]))


def test_folders_files_and_patterns_are_listed(store: fsspec.AbstractFileSystem, tmp_path: Path) -> None:
    def names(*texts: str) -> list[str]:
        return [str(one.path) for one in named_inputs(list(texts))]

    both = ["memory:///archive/a.mp4", "memory:///archive/deep/B.AVI"]
    assert names("memory://archive") == both
    assert names("memory://archive/**/*.AVI", "memory://archive/a.mp4") == [both[1], both[0]]
    assert names("memory://archive/gone.mp4") == ["memory://archive/gone.mp4"]
    (tmp_path / "list.txt").write_text("memory://archive/a.mp4\nhere.mp4\n")
    assert names(str(tmp_path / "list.txt")) == [both[0], str(tmp_path / "here.mp4")]
    with pytest.raises(InputError, match="no video in memory://archive/nothing"):
        named_inputs(["memory://archive/nothing*"])
    with pytest.raises(InputError, match="reading nosuch://a/b"):
        named_inputs(["nosuch://a/b"])


def test_a_file_is_fetched_as_it_was_listed(store: fsspec.AbstractFileSystem, tmp_path: Path) -> None:
    (one,) = remote_files("memory://archive/a.mp4", ())
    copies = [one.fetch(tmp_path / name) for name in ("new", "again")]
    assert {copy.read_bytes() for copy in copies} == {b"/archive/a.mp4"}
    assert len({copy.stat().st_mtime_ns for copy in copies}) == 1
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.mp4"]
    store.pipe_file("/archive/a.mp4", b"another")
    with pytest.raises(InputError, match="has changed since it was listed"):
        one.fetch(tmp_path / "new")
    (other,) = remote_files("memory://archive/a.mp4", ())
    assert other.fetch(tmp_path / "new").stat().st_mtime_ns != copies[1].stat().st_mtime_ns
    with pytest.raises(InputError, match=r"fetching memory://archive/gone\.mp4"):
        RemoteFile("memory://archive/gone.mp4").fetch(tmp_path)


def test_a_video_is_known_by_its_address_and_content(store: fsspec.AbstractFileSystem) -> None:
    def key() -> str:
        return videos_of(named_inputs(["memory://archive/a.mp4"]), {}, {})[0].key()

    first = key()
    assert key() == first
    store.pipe_file("/archive/a.mp4", b"another")
    assert key() != first


def test_results_are_those_ofcompared_files(tmp_path: Path) -> None:
    """`file://` goes the way of every store; s3:// is in test_engines.py."""
    write_videos(tmp_path / "videos", 2)
    write_tiny(tmp_path / "videos" / "no video", frames=2)
    options = ("--camera", CAMERA, "--quiet", *QUICK)
    folder = (tmp_path / "videos").as_uri()
    assert call("batch", f"{folder}/*.mp4", "--out", tmp_path / "fetched", "--workers", 1, *options) == 0
    rows = batch_rows(tmp_path / "fetched" / "batch.csv")
    assert {name: row["input"] for name, row in rows.items()} == {
        f"colon_0{number}": f"{folder}/colon_0{number}.mp4" for number in range(2)
    }
    assert not (tmp_path / "fetched" / ".fetched").exists()
    assert call("batch", tmp_path / "videos" / "colon_01.mp4", "--out", tmp_path / "files", *options) == 0
    assert compared_files(tmp_path / "fetched" / "colon_01") == compared_files(tmp_path / "files" / "colon_01")
