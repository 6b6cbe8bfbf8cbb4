"""A result has nothing of a patient's data, and what is installed has a known licence."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from docs.licences_page import PAGE, ROOT, dependencies
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth
from scopemap.engine.frame import Frame
from tests.support.drawn_dicom import PATIENT, write_dicom_video
from tests.support.drawn_inputs import picture
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import FRAMES, only_images, write_tiny

pytestmark = pytest.mark.slow

# Of the core; what each allows: use, change and distribution, also in closed programs.
PERMISSIVE = {
    *("0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0"),
    *("CC0-1.0", "CNRI-Python", "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Zlib", "any-OSI"),
}
OF_EXTRAS = PERMISSIVE | {"MPL-2.0", "LicenseRef-NVIDIA-Proprietary"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = [name for name in PROJECT["optional-dependencies"] if name not in ("dev", "test")] + ["bench", "baselines"]


def _parts(licence: str) -> set[str]:
    return set(re.split(r" AND | OR ", licence.replace("(", "").replace(")", "")))


def test_telemetry_of_dependencies_is_off_before_they_are_imported() -> None:
    names = ("ORT_DISABLE_TELEMETRY", "HF_HUB_DISABLE_TELEMETRY", "RAY_USAGE_STATS_ENABLED")
    code = f"import os, sys, scopemap; print(*(os.environ[n] for n in {names}), 'onnxruntime' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1", "0", "False"]


def _texts(folder: Path) -> str:
    """All that is in a file, or in the files of a folder, and their names."""
    files = [file for file in (folder, *folder.rglob("*")) if file.is_file()]
    return "".join(f"{file.name}\n{file.read_bytes().decode('latin-1')}" for file in files)


def _write_video(folder: Path) -> None:
    folder.mkdir()
    with av.open(str(folder / "clip.mp4"), "w") as container:
        container.metadata.update({"title": PATIENT, "comment": PATIENT})
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for number in range(6):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number, (160, 120)), format="rgb24")))
        container.mux(stream.encode())


def _write_pictures(folder: Path) -> None:
    folder.mkdir()
    exif = Image.Exif()
    exif[0x010E] = PATIENT  # ImageDescription
    for number in range(6):
        Image.fromarray(picture(number, (160, 120))).save(folder / f"{number}.jpg", exif=exif)


@pytest.mark.parametrize("write", [write_dicom_video, _write_video, _write_pictures])
def test_nothing_of_an_inputs_metadata_is_in_the_result(
    write: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The folders around the input are in provenance.json alone, by which a result finds it again."""
    around = tmp_path / "folder-around-it"
    around.mkdir()
    write(around / "in")
    assert PATIENT in _texts(around / "in")
    monkeypatch.chdir(around)
    source = Path("in") if write is _write_pictures else next(Path("in").iterdir())
    settings = ("--set", "tracking.method=paper", "--set", "input.skip_duplicates=false")
    code, said = call("run", source, "--out", tmp_path / "out", *settings), capfd.readouterr()
    assert code == 0, said.err
    texts = {file.name: _texts(file) for file in (tmp_path / "out").rglob("*") if file.is_file()}
    texts |= {"printed": said.out, "warned of": said.err}
    assert not [name for name, text in texts.items() if PATIENT in text]
    assert [name for name, text in texts.items() if around.name in text] == ["provenance.json"]


_BOX = (40, 30, 60, 24)


def _with_secret(folder: Path) -> Path:
    """Images of a phantom with white writing in a box, of twice the working size."""
    x, y, width, height = _BOX
    for file in sorted(folder.glob("*.png")):
        rgb = cv2.resize(cv2.imread(str(file)), None, fx=2, fy=2)
        rgb[y : y + height, x : x + width] = (0, 255, 0)
        cv2.imwrite(str(file), rgb)
    return folder


def test_what_is_redacted_is_black_wherever_pictures_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    source = _with_secret(only_images(write_tiny(tmp_path / "phantom"), tmp_path / "in"))
    x, y, width, height = (number // 2 for number in _BOX)
    seen: list[np.ndarray] = []
    estimate = ScopeNetDepth.estimate

    def spied(self: ScopeNetDepth, frame: Frame) -> DepthEstimate:
        seen.append(frame.rgb)
        return estimate(self, frame)

    monkeypatch.setattr(ScopeNetDepth, "estimate", spied)
    size, boxes = ("--size", "160x128"), ("--redact", ",".join(map(str, _BOX)), "--redact", "0,0,4,4")
    code, said = call("run", source, "--out", tmp_path / "out", *size, *boxes), capfd.readouterr()
    assert code == 0, said.err
    notices = json.loads((tmp_path / "out" / "provenance.json").read_text())["notices"]
    assert any(notice["text"].startswith("Redacted: 2 box(es) of each picture are black") for notice in notices)
    kept = [cv2.imread(str(file)) for file in (tmp_path / "out" / "frames").glob("*[0-9].jpg")]
    assert len(kept) == FRAMES
    assert len(seen) >= FRAMES
    for rgb in (*kept, *seen):
        factor = 160 // rgb.shape[1]
        inside = rgb[y // factor + 1 : (y + height) // factor - 1, x // factor + 1 : (x + width) // factor - 1]
        assert inside.size
        assert inside.max() < 24  # coding
    for file in (tmp_path / "out").rglob("*"):
        if file.suffix in (".jpg", ".png") and "depth" not in str(file) and "mask" not in file.name:
            picture = cv2.imread(str(file)).astype(int)
            green = picture[..., 1] - picture[..., [0, 2]].max(-1)
            assert (green > 150).mean() < 0.001, file
    colours = trimesh.load_mesh(tmp_path / "out" / "mesh.ply", process=False).visual.vertex_colors.astype(int)
    assert (colours[:, 1] - colours[:, [0, 2]].max(-1)).max() < 150


@pytest.mark.parametrize(("box", "fault"), [("400,0,9,9", "is outside of the pictures of"), ("1,2,3", "cannot read")])
def test_a_box_that_blackens_nothing_is_refused(
    box: str, fault: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = only_images(write_tiny(tmp_path / "phantom"), tmp_path / "in")
    assert fault in refused(capfd, "run", source, "--out", tmp_path / "out", "--redact", box)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_licences_are_permissive(extra: str) -> None:
    found = dependencies(extra) if extra else dependencies()
    allowed = OF_EXTRAS if extra else PERMISSIVE
    assert {name: text for name, text in found.items() if not _parts(text) <= allowed} == {}


def test_the_page_of_licences_names_what_the_core_needs() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert [name for name in dependencies() if f"| {name} | " not in page] == []
