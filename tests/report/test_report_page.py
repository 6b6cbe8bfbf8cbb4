"""The report of a run: what its page holds, its size, and that nothing in it asks for a network."""

from __future__ import annotations

import json
import os
import re
from base64 import b64decode, b64encode
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.engine.notices import Notice
from scopemap.report.facts import report_facts
from scopemap.report.frame_pictures import FramePictures
from scopemap.report.notebook import summary_html
from scopemap.report.page import page_html, write_comparison, write_report
from scopemap.report.page_data import page_data
from scopemap.report.shown_mesh import SeenFrame, simplified, times_seen
from scopemap.result.result import Result
from scopemap.result.summary import frames_per_s, time_words
from scopemap.result.verdict import state_verdict
from scopemap.result.wording import facts_of_notices
from tests.support.drawn_run import (
    CAMERA,
    FRAMES,
    IN_FIRST_MAP,
    IN_RESULT,
    LOST,
    changed,
    draw_run,
    drawn_result,
    pose_of,
    tube,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    files = write_report(folder)
    assert [file.name for file in files] == ["report.html", "summary.png"]
    return files[0].read_text(encoding="utf-8")


def shown(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])["runs"][0]


def numbers(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(b64decode(text), np.dtype(dtype).newbyteorder("<"))


def test_every_frame_is_on_the_page_with_its_pose_and_place(page: str) -> None:
    frames = shown(page)["frames"]
    assert frames["count"] == FRAMES
    assert numbers(frames["index"], "i4").tolist() == list(range(FRAMES))
    assert numbers(frames["place"], "i2").tolist() == [0] * IN_RESULT + [-1] * LOST + [1] * IN_FIRST_MAP
    poses = numbers(frames["pose"], "f8").reshape(-1, 3, 4)
    lost = slice(IN_RESULT, IN_RESULT + LOST)
    assert np.isnan(poses[lost]).all()
    np.testing.assert_allclose(poses[5], pose_of(5)[:3], atol=1e-5)
    np.testing.assert_allclose(poses[-1], pose_of(FRAMES - 1)[:3], atol=1e-5)
    assert {frames["reasons"][k] for k in numbers(frames["reason"], "i2")[lost]} == {"too blurred"}
    assert set(frames["curves"]) == {"inliers", "agreement", "scale", "moving", "sharpness", "ms"}
    assert np.isfinite(numbers(frames["curves"]["sharpness"], "f4")).all()


def test_the_meshes_are_those_of_the_run(page: str, folder: Path) -> None:
    maps = shown(page)["maps"]
    assert [one["frames"] for one in maps] == [IN_RESULT, IN_FIRST_MAP]
    mesh = Result(folder).mesh
    low, high = np.array(maps[0]["low"]), np.array(maps[0]["high"])
    positions = low + numbers(maps[0]["positions"], "u2").reshape(-1, 3) / 65535 * (high - low)
    np.testing.assert_allclose(positions, mesh.vertices, atol=1e-3)
    np.testing.assert_array_equal(numbers(maps[0]["faces"], "u4").reshape(-1, 3), mesh.faces)
    confidence = numbers(maps[0]["confidence"], "u1") / 255
    np.testing.assert_allclose(confidence, np.linspace(0, 1, len(mesh.vertices)), atol=3e-3)


def test_pictures_and_depth_are_those_of_the_frames(page: str, folder: Path) -> None:
    data = shown(page)
    assert [picture["row"] for picture in data["pictures"]] == Result(folder).pictured == list(range(FRAMES))
    coded = cv2.imdecode(np.frombuffer(b64decode(data["pictures"][3]["depth"]), np.uint8), cv2.IMREAD_COLOR)
    depth = Result(folder).depth.read(3)
    assert depth is not None
    assert coded is not None
    units = coded[..., 2].astype(np.float32) * 256 + coded[..., 1]
    assert (units > 0).mean() > 0.5
    np.testing.assert_array_equal(np.where(units > 0, units * np.float32(data["depth_unit_mm"]), np.nan), depth)


def test_the_page_asks_for_nothing_and_a_name_cannot_end_its_script(tmp_path: Path, page: str) -> None:
    assert not re.findall(r"https?://|//cdn|@import|<link|<iframe|src=\"(?!data:)", page)
    assert "default-src 'none'" in page
    hostile = "</script><script>alert(1)</script>{{style}}<!--.mp4"
    text = write_report(draw_run(tmp_path, name=hostile))[0].read_text(encoding="utf-8")
    assert shown(text)["name"] == "script>{{style}}<!--.mp4"
    assert shown(text)["input"] == hostile
    assert text.count("<script") == page.count("<script") == 2
    assert "alert(1)</script>" not in text


@pytest.mark.parametrize(
    ("given", "named"),
    [("/tmp/scopemap-x1/uploads/visit.mp4", "visit.mp4"), ("clips/visit.mp4", "clips/visit.mp4")],
)
def test_the_input_is_named_without_where_it_was(tmp_path: Path, given: str, named: str) -> None:
    run = draw_run(tmp_path / "run", pictures=False, name=given, input_absolute="/tmp/scopemap-x1/uploads/visit.mp4")
    text = write_report(run)[0].read_text(encoding="utf-8")
    assert (shown(text)["input"], shown(text)["name"]) == (named, "visit.mp4")
    assert "scopemap-x1" not in text


def test_a_name_may_be_no_utf8(tmp_path: Path) -> None:
    name = os.fsdecode(b"video\xe4.mp4")
    file = write_report(draw_run(tmp_path / "run", pictures=False, name=name))[0]
    text = file.read_text(encoding="utf-8")
    assert "<title>video?.mp4" in text
    assert shown(text)["name"] == name


@pytest.mark.parametrize(("name", "kept_name"), [(b'"\xe4\n, .png', '"?\n, .png'), (b"\xe2\x80\xa8.png", "\u2028.png")])
def test_frames_names_may_be_anything_that_files_names_are(tmp_path: Path, name: bytes, kept_name: str) -> None:
    result = drawn_result()
    result.frames.rows["name"] = os.fsdecode(name)
    result.save(tmp_path)
    frames = Result(tmp_path).frames
    assert frames["name"].tolist() == [kept_name] * FRAMES
    assert (frames.submap == 0).sum() == IN_RESULT


def test_a_long_run_stays_small(tmp_path: Path) -> None:
    pictures, noise = FramePictures(), np.random.default_rng(0).integers(0, 255, (256, 320, 3), dtype=np.uint8)
    for index in range(450):
        pictures.put(index, noise, np.ones((256, 320), bool))
    pictures.save(tmp_path)
    kept = Result(tmp_path).pictured
    assert kept == list(range(0, 450, 8))
    fewer = FramePictures()
    fewer.put(3, noise, np.ones((256, 320), bool))
    fewer.save(tmp_path / "again")
    pictures.save(tmp_path / "again")
    assert Result(tmp_path / "again").pictured == kept
    assert len(Result(tmp_path).measures) == 450
    run = Result(draw_run(tmp_path / "run"))
    for index in range(FRAMES):  # the heaviest pictures that there are
        run.picture_file(index).write_bytes(Result(tmp_path).picture_file(0).read_bytes())
    share = page_data(report_facts(run, 1000), share=0.05)
    assert 0 < len(share["pictures"]) < FRAMES
    assert len(json.dumps(share["pictures"])) < 0.05 * 12e6
    assert len(page_data(report_facts(run, 1000), share=1e-6)["pictures"]) == 1


def test_a_fine_mesh_is_simplified_and_keeps_its_colours() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=10)
    above = ball.vertices[:, 2] > 0
    colours = np.where(above[:, None], np.uint8([250, 0, 0]), np.uint8([0, 0, 250]))
    values = {"confidence": above.astype(np.float32)}
    ball = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=colours, vertex_attributes=values, process=False)
    few = simplified(ball, 2000)
    assert 1500 < len(few.faces) <= 2100
    np.testing.assert_allclose(np.linalg.norm(few.vertices, axis=1), 10, atol=0.1)
    above = few.vertices[:, 2] > 1
    assert (few.visual.vertex_colors[above, 0] == 250).all()
    assert (few.vertex_attributes["confidence"][above] == 1).all()
    assert simplified(few, 2500) is few


def test_a_run_without_pictures_mesh_or_depth_has_a_page(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, pictures=False, surface={})
    for name in ("mesh.ply", "maps/1/mesh.ply", "depth/depth.json", "config.toml"):
        (folder / name).unlink()
    data = shown(write_report(folder)[0].read_text(encoding="utf-8"))
    assert data["pictures"] == []
    assert [one["vertices"] for one in data["maps"]] == [0, 0]
    assert data["verdict"]["word"] == "not usable"


def test_several_runs_share_a_page(tmp_path: Path, folder: Path) -> None:
    other = draw_run(tmp_path / "other", surface={"coverage_mean": 0.3, "coverage_least": 0.1})
    write_comparison([folder, other], ["ours", "theirs"], tmp_path / "compare.html")
    text = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert "<title>ours, theirs" in text
    runs = json.loads(text.partition('id="data">')[2].partition("</script>")[0])["runs"]
    assert [(run["name"], run["verdict"]["word"]) for run in runs] == [("ours", "doubtful"), ("theirs", "not usable")]


def test_lengths_are_in_mm_only_where_the_scale_is_known(tmp_path: Path) -> None:
    scaled = Notice("fusion-scaled", {"voxel_mm": 0.39, "divisor": 128, "max_depth_mm": 78.0})
    far = Notice("fusion-too-far", {"median_mm": 90.0, "max_depth_mm": 78.0})
    in_mm = "Voxels measure 0.39 mm, 1/128 of the median depth; pixels beyond 78 mm are not fused. "
    in_units = (
        "Voxels measure 0.39 units (the scale is unknown), 1/128 of the median depth; pixels beyond 78 units are "
    )
    for known, said in ((True, in_mm), (False, in_units)):
        scale = {"known": known, "measured": known, "source": "a source"}
        folder = draw_run(tmp_path / str(known), scale=scale, notices=facts_of_notices([scaled, far]))
        found = page_data(report_facts(Result(folder), 1000))
        assert [note for note in found["notes"] if note.startswith(said)]
        reason = next(one for one in found["verdict"]["reasons"] if one["code"] == "fusion-too-far")
        assert (" mm" in reason["text"]) == known
        assert (" 78 units." in reason["text"]) == (not known)


def test_truth_is_shown_where_it_is_known(tmp_path: Path) -> None:
    truth = tmp_path / "truth"
    truth.mkdir()
    rows = [pose_of(i) for i in range(FRAMES)]
    for i, row in enumerate(rows):
        row[:3, 3] *= 2
        row[1, 3] += 0.3 * i**1.5
    # C3VD's form: one pose a line, column by column.
    (truth / "pose.txt").write_text("\n".join(" ".join(f"{v:.9f}" for v in row.T.ravel()) for row in rows))
    run = Result(draw_run(tmp_path / "run", name=str(truth)))
    found = page_data(report_facts(run, 1000))["truth"]
    assert found is not None
    assert numbers(found["positions"], "f4").size == 3 * IN_RESULT
    assert 0.001 < found["error_share"] < 0.2


def test_vertices_are_counted_where_a_frame_sees_them() -> None:
    mesh = tube()
    depth = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    none = times_seen(mesh, [SeenFrame(pose_of(0), depth)], CAMERA)
    assert not none.any()
    points = np.asarray(mesh.vertices)
    wall = points[:, 2] > 60  # in view from z = 0, at this distance
    depth[:] = 70.0
    seen = times_seen(mesh, [SeenFrame(pose_of(0), depth)] * 3, CAMERA)
    assert set(seen.tolist()) == {0, 3}
    assert seen[wall].max() == 3
    assert not seen[points[:, 2] < 60].any()


def test_summary_picture_has_the_verdicts_colour_frames_and_the_mesh(page: str, folder: Path) -> None:
    picture = cv2.imread(str(folder / "summary.png"))[..., ::-1].astype(int)
    assert picture.shape[1] == 1596
    assert np.abs(picture[2, 100] - (163, 90, 0)).max() < 3  # doubtful: 14 of 24 frames
    frame = cv2.imread(str(Result(folder).picture_file(0)))[..., ::-1].astype(int)
    corner = picture[104 + 26 : 104 + 26 + 307, 12 : 12 + 384]
    assert np.abs(corner.mean((0, 1)) - frame.mean((0, 1))).max() < 6
    mesh_row = picture[-400 - 410 : -410]
    assert (mesh_row.min(-1) < 240).mean() > 0.2
    # The last row: two pieces side by side, nothing in the third column.
    pieces = (picture[-400:].min(-1) < 240).reshape(400, -1)
    assert all(pieces[:, 12 + k * 396 : 396 + k * 396].mean() > 0.2 for k in (0, 1))
    assert not pieces[:, 2 * 396 + 12 :].any()


def test_every_picture_of_the_summary_has_a_scale_bar_where_sizes_are_known(tmp_path: Path) -> None:
    run = draw_run(tmp_path, scale={"known": True, "measured": True, "source": "measured depth"})
    picture = cv2.imread(str(write_report(run)[1]))
    boxes = cv2.connectedComponentsWithStats((picture == 0x10).all(axis=2).astype(np.uint8))[2][1:]
    # Four frames, their depths, four views of the surface, two submaps.
    assert (boxes[:, cv2.CC_STAT_AREA] > 1000).sum() == 14


def test_only_json_numbers_are_written() -> None:
    text = page_html([{"name": "a<b", "figure": float("nan"), "list": [1.0, float("inf")]}])
    assert "NaN" not in text.partition('id="data">')[2].partition("</script>")[0]
    assert "<title>a&lt;b" in text


@pytest.mark.usefixtures("page")  # writes summary.png
def test_prompt_and_report_tell_one_speed(folder: Path) -> None:
    result = drawn_result(name="video.mp4")
    result.provenance["seconds"] = {"total": 20.0, "compile kernels": 8.0}
    result.provenance["resumed_after_frame"] = None
    assert frames_per_s(result) == 24 / 12
    assert time_words(result) == "20.0 s, 2.0 frames/s"
    run = Result(folder)
    assert page_data(report_facts(run, 1000))["frames_per_s"] == frames_per_s(run)
    result.provenance["resumed_after_frame"] = int(result.frames["index"][11])
    assert frames_per_s(result) == 1.0
    assert frames_per_s(changed(result, provenance={})) is None


def test_a_result_shows_itself_in_one_line(page: str, folder: Path, tmp_path: Path) -> None:
    result = drawn_result(name="<b>video</b>.mp4")
    assert repr(result) == f"<Result, without a verdict: 14 of 24 frames are in it; {result.scale}>"
    state_verdict(result)
    assert repr(result).startswith("<Result, doubtful: 14 of 24 frames are in it; scale unknown")
    assert "7 of 7 frames are in it" in repr(result.others[0])
    assert repr(Result(tmp_path)) == f"<Result, not finished: {tmp_path}>"
    assert result._repr_html_() == f"<p>{escape(repr(result))}</p>"
    picture = b64encode((folder / "summary.png").read_bytes()).decode()
    assert f"data:image/png;base64,{picture}" in Result(folder)._repr_html_()


def test_a_notebook_shows_the_summary_picture_of_a_run(page: str, folder: Path) -> None:
    html = summary_html(drawn_result(name="<b>video</b>.mp4"))
    assert "doubtful: 14 of 24 frames are in the result, others in 1 submap (1 not usable). " in html
    content = b64decode(re.findall(r"data:image/jpeg;base64,([^\"]+)", html)[0])
    inline = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR).astype(int)
    written = cv2.imread(str(folder / "summary.png")).astype(int)
    # The same sheet without frames and depth, which are not in memory: head, then the views of the mesh.
    assert inline.shape[1] == written.shape[1]
    assert inline.shape[0] < 1000
    assert np.abs(inline[-380:] - written[-380:]).mean() < 4
    assert np.abs(inline[:100] - written[:100]).mean() < 4
