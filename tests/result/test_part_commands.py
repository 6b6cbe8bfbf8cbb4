"""Commands on the result of a part of a video (`--frames A:B`), whose other frames have another size."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from scopemap.result.result import Result
from scopemap.runner.reread_frames import open_input, tracked_frames
from tests.support.front_door import call
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import only_images, write_tiny

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]
FIRST, COUNT = 12, 9


def _part(file: Path, pictures: list[np.ndarray]) -> bytes:
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 6_000_000
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    return file.read_bytes()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A video of 12 small frames and 9 larger ones, and the result of those."""
    folder = tmp_path_factory.mktemp("part")
    images = only_images(write_tiny(folder / "phantom"), folder / "images")
    pictures = [cv2.imread(str(file)) for file in sorted(images.iterdir())]
    small = [cv2.resize(pictures[k % COUNT], (96, 64)) for k in range(FIRST)]
    video = folder / "v.ts"
    video.write_bytes(_part(folder / "a.ts", small) + _part(folder / "b.ts", pictures))
    part = f"--frames={FIRST}:{FIRST + COUNT}"
    shown = ("--set", "input.skip_duplicates=false")
    assert call("run", video, "--out", folder / "result", part, "--preset", "realtime", "--quiet", *shown) == 0
    return video, folder / "result"


def test_numbers_are_those_of_the_video(made: tuple[Path, Path]) -> None:
    numbers = [int(row["index"]) for row in frame_rows(made[1])]
    assert len(numbers) >= COUNT - 1  # the decoder keeps the last picture before a change back
    assert set(numbers) <= set(range(FIRST - 1, FIRST + COUNT))
    assert Result(made[1]).provenance["selection"]["frames"] == f"{FIRST}:{FIRST + COUNT}"


def test_the_input_is_read_again_as_the_run_read_it(made: tuple[Path, Path]) -> None:
    run = Result(made[1])
    sequence, _ = open_input(run.folder)
    assert {frame.index for frame in sequence.frames()} == set(run.frames["index"].tolist())
    frames = {frame.index: frame for frame in tracked_frames(run)}
    assert set(frames) == set(run.tracked["index"].tolist())
    for index in run.pictured:
        kept = cv2.imread(str(run.picture_file(index)))[..., ::-1]
        if index in frames:
            assert np.abs(cv2.resize(frames[index].rgb, kept.shape[1::-1]).astype(int) - kept).mean() < 6


@pytest.mark.parametrize("to", ["nerfstudio", "colmap", "euroc", "tum"])
def test_exports(to: str, made: tuple[Path, Path], tmp_path: Path) -> None:
    assert call("export", made[1], "--to", to, "--out", tmp_path / "out") == 0


def test_locate_evaluate_and_inspect(made: tuple[Path, Path], tmp_path: Path, capfd: Capture) -> None:
    video, result = made
    still = tmp_path / "still.png"
    index = int(Result(result).tracked["index"][2])
    frame = next(frame for frame in tracked_frames(Result(result)) if frame.index == index)
    assert cv2.imwrite(str(still), frame.rgb[..., ::-1])
    assert call("locate", result, still, "--out", tmp_path / "located") in (0, 1)
    said = capfd.readouterr()
    assert "no frame" not in said.err
    assert "another camera" not in said.err
    assert call("evaluate", result, "--against-video") == 0
    assert call("inspect", video, f"--frames={FIRST}:{FIRST + COUNT}", "--out", tmp_path / "sheet.png") == 0
