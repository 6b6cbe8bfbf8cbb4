"""Commands that the pages show run as they stand, where small drawn inputs can take the names that they use."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.apps.demo import demo as demonstration
from scopemap_bench.scripts.demo_clip import SPEC, write_clip
from tests.support.documented import DOCUMENTS, commands
from tests.support.drawn_boards import CHECKERBOARD, PINHOLE, Studio
from tests.support.drawn_run import draw_run
from tests.support.drawn_videos import encode
from tests.support.front_door import call

pytestmark = pytest.mark.slow

ONLY_PARSED = {
    r"^bench (?!speed my)|^datasets|^climb|SCARED|CLIMB|CLIP|FOLDER|/archive/": "data sets and benchmarks are not here",
    r"^models pull": "downloads",
    r"^demo|^phantom|^run (?:colon|laparoscopy)/": "takes minutes; the tests of these commands run smaller ones",
    r"^live (?:0|rtsp)|^view \w+(?: --compare \w+)?$|^app|--app": "needs a camera, or ends by Ctrl-C",
    r"--engine ray": "needs a cluster",
    r"--stereo use": "needs a stereo endoscope",
    r"^measure result$": "needs what somebody has measured in the window; test_browser_measures.py runs it",
    r"766\.3|--frame 68|--charuco": "belongs to another endoscope, clip or board",
    r"scopemap-demo/": "tests/house/test_documented_commands.py runs it",
}
"""Commands that are not run here, and why; test_documented_commands parses them."""


def _runnable(document: Path) -> list[list[str]]:
    return [one for one in commands(document) if not any(re.search(kind, " ".join(one)) for kind in ONLY_PARSED)]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages name: videos, a calibration, a board, masks, truths and results."""
    folder, clip = tmp_path_factory.mktemp("named"), tmp_path_factory.mktemp("clip")
    write_clip(clip, replace(SPEC, frames=30, width=160, height=128))
    for name in ("my", "first", "second", "surgery", "videos/a", "videos/b"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(clip / "colon.mp4", folder / f"{name}.mp4")
    numbers = {"fx": 766, "fy": 766, "cx": 400, "cy": 92, "width": 640, "height": 512}
    (folder / "calibration.yaml").write_text("".join(f"{name}: {value}\n" for name, value in numbers.items()))
    studio = Studio(PINHOLE, CHECKERBOARD)
    encode(folder / "board.mp4", [studio.shot(pose, seed=n) for n, pose in enumerate(studio.poses(24))])

    packaged = Path(demonstration.__file__).parent / "clip"
    for name in ("TRUTH", "THEIRS.txt"):
        shutil.copy(packaged / "pose.txt", folder / name)
    run = (packaged / "colon.mp4", "--camera", packaged / "camera.yaml", "--near-far", "5:60", "--quiet")
    assert call("run", *run, "--out", folder / "result") == 0
    for name in ("RESULT", "RUN", "OTHER"):
        shutil.copytree(folder / "result", folder / name)
    shutil.copytree(draw_run(clip / "drawn") / "maps/1", folder / "result/maps/1")
    lesion, shaft = np.zeros((2, 256, 320), np.uint8)
    cv2.circle(lesion, (150, 120), 20, 255, -1)
    shaft[150:165, 200:] = 255
    (folder / "masks").mkdir()
    named = {f"masks/{n:03d}.png": lesion for n in range(28, 33)} | {"mask.png": lesion, "shaft.png": shaft}
    for file, mask in named.items():
        cv2.imwrite(str(folder / file), mask)
    return folder


@pytest.mark.parametrize("document", [one for one in DOCUMENTS if _runnable(one)], ids=lambda path: path.name)
def test_commands_run_as_the_page_shows_them(
    document: Path, drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In their order, in one folder; the clips have a fiftieth of the frames of a page's, and seconds to match."""
    shutil.copytree(drawn, tmp_path / "page")
    monkeypatch.chdir(tmp_path / "page")
    for arguments in _runnable(document):
        shorter = [re.sub(r"^(\d+):(\d+)$", lambda f: f"{int(f[1]) // 50}:{int(f[2]) // 50}", one) for one in arguments]
        shorter = [{"12.5": "0.5", "60": "3"}.get(one, one) for one in shorter]
        if arguments[0] == "calibrate":  # the runs after it use a calibration of the clip
            shorter += ["--out", "board.yaml"]
        if arguments[0] == "run":
            shutil.rmtree(arguments[arguments.index("--out") + 1], ignore_errors=True)
        assert call(*shorter) == 0, arguments


def test_every_reason_not_to_run_a_command_is_in_use() -> None:
    shown = [" ".join(one) for document in DOCUMENTS for one in commands(document)]
    assert [kind for kind in ONLY_PARSED if not any(re.search(kind, one) for one in shown)] == []
