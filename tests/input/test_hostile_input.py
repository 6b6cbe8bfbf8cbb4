"""Input that means harm: archives that lead outside, files that grow while they are read. Refused, or harmless.

What single parsers are held to is in test_datasets_limits, test_numbered_files and test_decoding.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType

import av
import numpy as np
import pytest

from scopemap.engine.errors import InputError, ScopemapError
from scopemap.input.opening import open_sequence
from scopemap.result.trajectories import read_trajectory
from tests.support.drawn_datasets import WRITERS, read_all
from tests.support.drawn_image_sets import write_real
from tests.support.drawn_trajectories import write_trajectories

# ---- archives whose members lead outside


def test_a_recording_that_names_files_outside_is_refused(tmp_path: Path) -> None:
    folder = WRITERS["rosbag:ros2"](tmp_path / "input")
    (file,) = folder.glob("*.db3")
    file.rename(tmp_path / "outside.db3")
    text = (folder / "metadata.yaml").read_text()
    for name in ("../outside.db3", str(tmp_path / "outside.db3")):
        (folder / "metadata.yaml").write_text(text.replace(file.name, name))
        with pytest.raises(InputError):
            read_all(folder)


# ---- pipes: whoever opens one waits forever


@pytest.fixture
def at_once() -> Iterator[None]:
    def too_late(number: int, frame: FrameType | None) -> None:
        # No OSError, which would be taken for a file that cannot be read.
        pytest.fail("it waits for a pipe")

    before = signal.signal(signal.SIGALRM, too_late)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")


@needs_pipes
@pytest.mark.parametrize("name", ["clip.mp4", "clip.bag", "clip.dcm", "clip"])
def test_a_pipe_is_one_sentence(name: str, tmp_path: Path, at_once: None) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: it is no file and no folder"):
        open_sequence(tmp_path / name)


@needs_pipes
@pytest.mark.parametrize(
    "name", ["7-scenes", "colmap:bin", "dicom:frames", "endoslam:real", "rosbag:ros2", "scared", "tum"]
)
def test_pipes_in_the_place_of_files_end_reading_at_once(name: str, tmp_path: Path, at_once: None) -> None:
    entry = WRITERS[name](tmp_path / "input")
    files = {(f.parent, f.suffix): f for f in sorted((tmp_path / "input").rglob("*")) if f.is_file()}
    for file in files.values():
        content = file.read_bytes()
        file.unlink()
        os.mkfifo(file)
        with suppress(ScopemapError):
            read_all(entry)
        file.unlink()
        file.write_bytes(content)
    read_all(entry)


@needs_pipes
@pytest.mark.parametrize("name", ["run/frames.csv", "run/trajectory.tum", "splatam/config.py", "kitti.txt"])
def test_pipes_in_the_place_of_trajectories_end_reading_at_once(name: str, tmp_path: Path, at_once: None) -> None:
    write_trajectories(tmp_path / "poses")
    file = tmp_path / "poses" / name
    file.unlink()
    os.mkfifo(file)
    os.mkfifo(tmp_path / "params.npz")
    for path in (file, file.parent, tmp_path / "params.npz"):
        with pytest.raises(ScopemapError):
            read_trajectory(path)


# ---- files that grow while they are read


ENTITIES = "<!DOCTYPE x [<!ENTITY a0 'ha'>{}]>".format(
    "".join(f"<!ENTITY a{i} '{f'&a{i - 1};' * 9}'>" for i in range(1, 10))
)


@pytest.mark.parametrize("how", ["entities", "zeros"])
def test_a_workbook_that_grows_is_refused(how: str, tmp_path: Path) -> None:
    folder = write_real(tmp_path / "HighCam" / "Colon-IV" / "TumorfreeTrajectory_1")
    (file,) = folder.rglob("*.xlsx")
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    bomb = f"{ENTITIES}<worksheet>&a9;</worksheet>".encode() if how == "entities" else b" " * (64 << 20)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (members | {"xl/worksheets/sheet1.xml": bomb}).items():
            archive.writestr(name, data)
    assert file.stat().st_size < 100_000
    with pytest.raises(InputError, match=r"poses\.xlsx"):
        open_sequence(folder)


def test_a_video_of_pictures_beyond_the_limit_takes_no_memory(tmp_path: Path) -> None:
    """Some 400 kB that are two pictures of 200 MB each: FFmpeg would unpack one to see what it is."""
    file = tmp_path / "clip.mov"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("png", rate=25)
        stream.width = stream.height = 8192
        stream.pix_fmt = "gray"
        for _ in range(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((8192, 8192), np.uint8), format="gray")))
        container.mux(stream.encode())
    code = (
        "import resource, sys\nfrom scopemap.input.video import VideoFile\n"
        "from scopemap.engine.errors import InputError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: VideoFile(__import__('pathlib').Path(sys.argv[1]))\nexcept InputError as error: print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    said = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True).stdout
    assert "more than 64 million pixels" in said
    assert "SCOPEMAP_MAX_MEGAPIXELS" in said
    assert int(said.splitlines()[-1]) < 60_000, "kB of memory"
