"""The input of a run is found from any folder: beside the result, where it was, by its content, or by `--input`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.result.result import Result
from scopemap.result.run_input import find_input, stated_input
from scopemap.runner.reread_frames import reread_frames
from tests.support.drawn_run import CAMERA, FRAMES, draw_run, draw_run_of_frames, pose_of, tube
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import only_images, write_tiny


@pytest.fixture
def video(tmp_path: Path) -> tuple[Path, Path]:
    """A file as input, and the folder of a run that read it."""
    place, run = tmp_path / "study" / "clip" / "a.mp4", tmp_path / "study" / "run"
    place.parent.mkdir(parents=True)
    run.mkdir()
    place.write_bytes(bytes(range(200)))
    (run / "provenance.json").write_text(json.dumps(stated_input(place, run)))
    return place, run


def test_an_input_is_found_from_any_folder(
    video: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, run = video
    facts = json.loads((run / "provenance.json").read_text())
    assert facts["input_relative"] == str(Path("../clip/a.mp4"))
    assert facts["input_absolute"] == str(place)
    monkeypatch.chdir(tmp_path)
    assert find_input(Path("study/run")).resolve() == place
    (run / "maps" / "1").mkdir(parents=True)
    (run / "maps" / "1" / "provenance.json").write_text(json.dumps({"input": "elsewhere.mp4"}))
    assert find_input(run / "maps" / "1").resolve() == place
    # With its result.
    (tmp_path / "study").rename(tmp_path / "other")
    assert find_input(tmp_path / "other" / "run") == tmp_path / "other" / "clip" / "a.mp4"
    # The result alone, the input where it was.
    (tmp_path / "study" / "clip").mkdir(parents=True)
    (tmp_path / "other" / "clip" / "a.mp4").rename(place)
    assert find_input(tmp_path / "other" / "run") == place
    # By its content, under another name.
    place.rename(tmp_path / "other" / "b.mp4")
    assert find_input(tmp_path / "other" / "run") == tmp_path / "other" / "b.mp4"


def test_another_file_in_its_place_is_not_taken_for_it(video: tuple[Path, Path], tmp_path: Path) -> None:
    place, run = video
    kept = shutil.copyfile(place, tmp_path / "kept.mp4")
    place.write_bytes(bytes(200))
    with pytest.raises(InputError, match=r"a\.mp4 of the run .* is another file now; name the input with --input PATH"):
        find_input(run)
    assert find_input(run, kept) == kept
    with pytest.raises(InputError, match=r"is not the file that the run .* read .*: its content differs"):
        find_input(run, place)
    place.unlink()
    with pytest.raises(InputError, match=r"was not found; name it with --input PATH"):
        find_input(run)
    with pytest.raises(InputError, match=r"there is no .*gone\.mp4, which --input names"):
        find_input(run, tmp_path / "gone.mp4")


@pytest.mark.slow
def test_a_run_states_its_input_by_three_paths_and_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only_images(write_tiny(tmp_path / "phantom", frames=5), tmp_path / "images")
    monkeypatch.chdir(tmp_path)
    config = Config.load("realtime", settings={"input.focal": "assume"})
    reconstruct(open_sequence("images"), config, out="out/run")
    facts = Result("out/run").provenance
    assert (facts["input"], facts["input_relative"]) == ("images", str(Path("../../images")))
    assert facts["input_absolute"] == str(tmp_path / "images")
    monkeypatch.chdir("/")
    assert call("export", tmp_path / "out/run", "--to", "nerfstudio", "--out", tmp_path / "nerf") == 0
    assert len(list((tmp_path / "nerf" / "images").iterdir())) == 5


@pytest.mark.parametrize("to", ["colmap", "nerfstudio", "endogslam", "endonerf", "mcap"])
def test_exports_are_told_where_the_input_is(
    to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    run = draw_run_of_frames(tmp_path)
    (tmp_path / "frames").rename(tmp_path / "moved")
    shutil.rmtree(run / "frames")
    monkeypatch.chdir("/")
    out = tmp_path / ("out.mcap" if to == "mcap" else "out")
    said = refused(capfd, "export", run, "--to", to, "--out", out)
    assert "name it with --input PATH; frames/ has no picture of 14 of the 14 frames" in said
    assert call("export", run, "--to", to, "--out", out, "--input", tmp_path / "moved") == 0


def test_the_pictures_of_a_run_serve_where_its_input_is_gone(tmp_path: Path) -> None:
    run = draw_run(tmp_path / "run")
    found = {frame.index: frame for frame in reread_frames(run, {3, 5})}
    assert sorted(found) == [3, 5]
    drawn = render_mesh(tube(), CAMERA, pose_of(3))
    assert np.abs(found[3].rgb.astype(int) - drawn.rgb).mean() < 8
    expected = np.isfinite(drawn.depth_mm)
    expected[:, :4] = False
    np.testing.assert_array_equal(found[3].valid, expected)
    Result(run).picture_file(FRAMES - 1).unlink()
    with pytest.raises(InputError, match=r"frames/ has no picture of 1 of the 2 frames"):
        list(reread_frames(run, {3, FRAMES - 1}))
    facts = json.loads((run / "provenance.json").read_text())
    facts["camera"] |= {"width": 800, "height": 640}
    (run / "provenance.json").write_text(json.dumps(facts))
    with pytest.raises(InputError, match=r"frames/ has no picture of frame 3 that is large enough"):
        list(reread_frames(run, {3}))
