"""Two examinations of a plane that is seen in closed form: a spot and a bump are new; the second is of another size."""

from __future__ import annotations

import json
import re
import shutil
from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.apps.exams import registration
from scopemap.apps.exams.change import Change, changes_of_both
from scopemap.apps.exams.compare_exams import ExamComparison, compare_exams
from scopemap.apps.exams.examination import Examination
from scopemap.apps.exams.exams_page import facts_of
from scopemap.apps.exams.fit import GOOD_RESIDUAL, MOST_FAR, MOST_RESIDUAL, ExamFit, fit_of, judgement
from scopemap.apps.exams.wording import names_of, summary
from scopemap.apps.measure.hand_measure import HandMeasure, add_measurement
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from tests.support.drawn_run import Shown, changed, drawn_result
from tests.support.front_door import call, refused
from tests.support.plane_scene import CAMERA, EVERYWHERE, PLANE_MM, pose, see

pytestmark = pytest.mark.slow

CAMERA_FACTS = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
ANOTHER_WORLD = Similarity(1.3, so3_exp(np.array([0.2, -0.5, 0.9])), np.array([30.0, -8.0, 4.0]))
SPOT_MM, BUMP_MM, RADIUS_MM, RISE_MM = np.array([8.0, 4.0]), np.array([-8.0, -5.0]), 4.0, 2.5


def surface(seed: int, half_mm: float, changed: bool) -> trimesh.Trimesh:
    """The plane with noise; changed: with a red spot, and a bump towards the camera."""
    count, rng = round(4 * half_mm) + 1, np.random.default_rng(seed)
    side = np.linspace(-half_mm, half_mm, count)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    xy = np.stack([x, y], -1)
    spot, bump = (np.linalg.norm(xy - middle, axis=1) < RADIUS_MM for middle in (SPOT_MM, BUMP_MM))
    z = PLANE_MM + rng.normal(0, 0.05, len(xy)) - changed * RISE_MM * bump
    colours = np.clip(rng.normal([180, 120, 100], 3, (len(xy), 3)), 0, 255)
    colours[spot & changed, 1:] *= 0.6
    corner = np.arange(count * (count - 1)).reshape(-1, count)[:, :-1].ravel()
    faces = [np.stack([corner + k, corner + 1 + k * count, corner + count], -1) for k in (0, 1)]
    return trimesh.Trimesh(
        np.column_stack([xy, z]), np.concatenate(faces), vertex_colors=colours.astype(np.uint8), process=False
    )


def examined(folder: Path, poses: list[np.ndarray], mesh: trimesh.Trimesh, world: Similarity) -> Path:
    """A run that saw the plane from poses, in another world."""
    kept, write, rows = FramePictures(), DepthWriter(folder), []
    for index, T in enumerate(poses):
        view = see(T)
        frame = Frame(index, index / 25, view.rgb, CAMERA, EVERYWHERE, np.float32(world.scale) * view.depth_mm, T)
        write(frame)
        kept(Shown(frame))
        T_own = world.transform_poses(T[None])[0]
        rows.append({"index": index, "time_s": index / 25, "keyframe": index, "status": "ok", "T_world_camera": T_own})
    kept.save(folder)
    mesh.vertices = world.transform_points(np.asarray(mesh.vertices))
    facts = drawn_result(camera=CAMERA_FACTS | {"source": "calibration file camera.yaml"})
    changed(facts, camera=CAMERA, source_camera=CAMERA, mesh=mesh, others=[], frames=FrameTable.of(iter(rows))).save(
        folder
    )
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("exams")
    first = [pose(at_mm=(x, 0.0, 0.0)) for x in np.linspace(-10, 10, 6)]
    second = [pose(at_mm=(x, 2.0, 3.0), turn_rad=(0.03, 0.0, 0.3)) for x in np.linspace(9, -11, 6)]
    return (
        examined(folder / "first", first, surface(1, 60.0, False), Similarity.identity()),
        examined(folder / "second", second, surface(2, 45.0, True), ANOTHER_WORLD),
    )


@pytest.fixture(scope="module")
def found(runs: tuple[Path, Path]) -> ExamComparison:
    return compare_exams(*runs)


def test_the_second_is_brought_to_the_first(found: ExamComparison) -> None:
    wanted = ANOTHER_WORLD.inverse()
    by = found.registration
    assert (by.located_first, by.located_second) == (1, 1)
    assert by.S_first_second.scale == pytest.approx(wanted.scale, rel=0.01)
    assert np.median(np.abs(np.asarray(found.second.vertices)[:, 2] - PLANE_MM)) < 0.5
    assert len(found.views) == 6
    assert all(one + other == 5 for one, other in found.views[1:-1])  # it came from the other side


def test_a_spot_and_a_bump_are_the_changes(found: ExamComparison) -> None:
    by_what = {change.what: change for change in found.changes}
    assert set(by_what) == {"colour", "shape"}
    spot, bump = by_what["colour"], by_what["shape"]
    for change, middle in ((spot, SPOT_MM), (bump, BUMP_MM)):
        assert np.linalg.norm(change.place_mm - [*middle, PLANE_MM]) < 1.0
        assert change.area_mm2 == pytest.approx(np.pi * RADIUS_MM**2, rel=0.5)
        assert min(change.frames) >= 0
    assert spot.redness == pytest.approx(-np.log(0.6), abs=0.15)
    assert bump.rise_mm == pytest.approx(RISE_MM, abs=0.6)


def test_the_vertices_say_where_it_changed(runs: tuple[Path, Path], found: ExamComparison) -> None:
    xy = np.asarray(Result(runs[0]).mesh.vertices)[:, :2]
    apart = np.min([np.linalg.norm(xy - middle, axis=1) for middle in (SPOT_MM, BUMP_MM)], axis=0)
    of_first, of_second = found.compared
    assert (of_first[apart < 0.4 * RADIUS_MM] == 2).all()
    assert (of_first[apart > 2 * RADIUS_MM] < 2).all()
    assert set(np.unique(of_first)) == {0, 1, 2}
    xy = np.asarray(found.second.vertices)[:, :2]
    apart = np.min([np.linalg.norm(xy - middle, axis=1) for middle in (SPOT_MM, BUMP_MM)], axis=0)
    assert (of_second[apart < 0.4 * RADIUS_MM] == 2).all()
    assert (of_second[apart > 2 * RADIUS_MM] < 2).all()


def test_what_only_one_saw(found: ExamComparison) -> None:
    # Of a plane of 120 mm the other covers 90 mm, and 4 mm around it are near.
    assert found.only_first == pytest.approx(1 - (98 / 120) ** 2, abs=0.03)
    assert found.only_second == 0


def test_the_same_examination_has_no_change(runs: tuple[Path, Path]) -> None:
    same = compare_exams(runs[0], runs[0])
    assert same.changes == []
    assert same.fit is ExamFit.GOOD
    assert same.registration.S_first_second.scale == pytest.approx(1, abs=1e-3)


def test_the_command_writes_a_page(runs: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "out.mp4"
    assert call("compare-exams", *runs, "--out", tmp_path / "out", "--video", film) == 0
    assert film.stat().st_size > 1000
    said = capfd.readouterr().out
    assert said.startswith("They fit: matched points are ")
    assert "2 places changed" in said
    assert "Found in first: 100% of the keyframes of second." in said
    facts = json.loads((tmp_path / "out" / "changes.json").read_text())
    assert len(facts["changes"]) == 2
    assert (facts["fit"], facts["located_first"]) == ("fit", 1)
    assert facts["registered_by"] in ("first", "second")
    assert "area_unit2" in facts["changes"][0]  # its scale is not known
    page = (tmp_path / "out" / "compare.html").read_text()
    assert page.count("<tr>") == 3
    assert "Above 0 the wall is nearer to the camera, and redder, in second." in page
    assert page.index("<strong>They fit: ") < page.index("Found in first")
    assert "In the views of both: 2; in those of first alone: 0, of second alone: 0." in said
    assert [change["seen_in"] for change in facts["changes"]] == ["both", "both"]
    # One file: it needs nothing beside it.
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["changes.json", "compare.html", "second.ply"]
    sources = re.findall(r"src='([^']*)'", page)
    assert len(sources) == page.count("<img") == 2
    for source in sources:
        kind, content = source.split(",")
        assert kind == "data:image/jpeg;base64"
        assert cv2.imdecode(np.frombuffer(b64decode(content), np.uint8), cv2.IMREAD_COLOR).shape[0] > 100
    assert "exists" in refused(capfd, "compare-exams", *runs, "--out", tmp_path / "out")
    assert "no finished run" in refused(capfd, "compare-exams", runs[0], tmp_path, "--out", tmp_path / "b")


def test_the_order_does_not_decide_whether_they_fit(runs: tuple[Path, Path], found: ExamComparison) -> None:
    back = compare_exams(runs[1], runs[0])
    one, other = found.registration, back.registration
    assert other.residual == pytest.approx(one.residual)
    assert (other.by_second, other.located_first) == (not one.by_second, one.located_second)
    assert back.fit is found.fit is ExamFit.GOOD
    # Nor what changed: the same places, of the same kind, seen from the other side.
    S = one.S_first_second
    assert {change.seen_in for change in [*found.changes, *back.changes]} == {"both"}
    assert len(found.changes) == len(back.changes) == 2
    for change, same in zip(found.changes, back.changes, strict=True):
        assert same.what == change.what
        # Each is on its own surface, and the bump's rises.
        assert np.linalg.norm((S.transform_points(same.place_mm) - change.place_mm)[:2]) < 1.0
        assert same.area_mm2 * S.scale**2 == pytest.approx(change.area_mm2, rel=0.02)
        assert same.rise_mm * S.scale == pytest.approx(-change.rise_mm, rel=0.02)
        assert same.redness == pytest.approx(-change.redness, rel=0.02)
        assert same.frames == change.frames[::-1]


def test_a_change_that_one_side_saw_is_listed_as_its_own() -> None:
    def seen(x: float, what: str, sigmas: float, side: str = "first") -> Change:
        return Change(what, np.array([x, 0.0, 0.0]), np.pi, 0.3, 0.1, sigmas, 4, (1, 2), side)  # type: ignore[arg-type]

    of_first = [seen(0, "shape", 9), seen(10, "colour", 40), seen(20, "shape", 12)]
    of_second = [seen(12.2, "shape", 10, "second"), seen(22.5, "shape", 50, "second")]
    found = changes_of_both(of_first, of_second, 0.0)
    # Circles of 1 mm that rise by 0.3: the second touches, the third does not.
    assert [(change.seen_in, change.what, change.sigmas) for change in found] == [
        ("both", "shape and colour", 40),
        ("second", "shape", 50),
        ("first", "shape", 12),
        ("first", "shape", 9),
    ]
    assert (found[0].place_mm[0], found[0].views) == (10, 8)
    # Nor are surfaces apart that lie as far from each other everywhere.
    assert sum(change.seen_in == "both" for change in changes_of_both(of_first, of_second, 0.6)) == 2
    turned = changes_of_both(of_second, of_first, 0.0)
    assert [(change.seen_in, change.what) for change in turned] == [(change.seen_in, change.what) for change in found]


def test_what_the_views_of_the_second_show_is_told_in_the_world_of_the_first() -> None:
    S = Similarity(2.0, so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.0, 0.0, 5.0]))
    change = Change("shape", np.array([1.0, 0.0, 0.0]), 3.0, 0.5, 0.2, 9.0, 4, (7, 8)).of_second(S)
    assert change.place_mm == pytest.approx([0, 2, 5])
    assert (change.area_mm2, change.rise_mm, change.redness) == (12.0, -1.0, -0.2)
    assert (change.frames, change.seen_in) == ((8, 7), "second")


def test_the_way_whose_points_agree_better_is_kept(
    runs: tuple[Path, Path], found: ExamComparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = {runs[0].name}

    def spoiled(one: Examination, other: Examination) -> tuple[registration.Correspondences3D, int]:
        pairs, located = whole(one, other)
        if one.folder.name in bad:
            pairs = pairs._replace(second=np.random.default_rng(0).permutation(pairs.second))
        return pairs, located

    whole = registration._correspondences
    monkeypatch.setattr(registration, "_correspondences", spoiled)
    one, other = (Examination(folder) for folder in runs)
    for spoiled_map in runs:
        bad = {spoiled_map.name}
        kept = registration.register(one, other)
        assert kept.by_second == (spoiled_map == runs[1])
        assert kept.residual < GOOD_RESIDUAL
    bad = {folder.name for folder in runs}
    none = compare_exams(*runs)
    assert none.registration.residual > MOST_RESIDUAL
    assert none.fit is ExamFit.NONE
    assert (none.changes, [side.any() for side in none.compared]) == ([], [False, False])
    assert facts_of(none, "mm")["changes"] is None
    said = list(summary(none, "guessed", ("a", "b")))
    assert said[0].startswith("They do not fit: matched points are ")
    assert "Changed places are not judged." in said
    assert not any("changed by more" in line for line in said)


def test_the_judgement_has_the_figures_that_decide() -> None:
    assert fit_of(GOOD_RESIDUAL, 0.9, 0.1) is ExamFit.GOOD
    assert judgement(0.021, 0.9, 0.1) == "They fit: matched points are 2.1% of the depth apart (median)."
    assert fit_of(GOOD_RESIDUAL + 0.01, 0.0, 0.0) is ExamFit.ROUGH
    assert judgement(0.1, 0.4, 0.5).startswith("They fit roughly: matched points are 10.0% of the depth apart")
    assert fit_of(0.01, MOST_FAR + 0.2, MOST_FAR + 0.1) is ExamFit.ROUGH
    assert "but 60% or more of each surface is far from the other" in judgement(0.01, 0.7, 0.6)
    assert fit_of(MOST_RESIDUAL + 0.01, 0.0, 0.0) is ExamFit.NONE
    assert judgement(0.286, 0.88, 0.63) == (
        "They do not fit: matched points are 28.6% of the depth apart (median); do not rely on what follows."
    )


def test_examinations_have_their_names_where_these_differ() -> None:
    assert names_of("before", "after") == ("before", "after")
    assert names_of("result", "result") == ("the first", "the second")


def test_other_places_cannot_be_compared(runs: tuple[Path, Path], tmp_path: Path) -> None:
    far = [pose(at_mm=(x, 90.0, 0.0)) for x in np.linspace(-10, 10, 6)]
    other = examined(tmp_path / "far", far, surface(3, 30.0, False), Similarity.identity())
    with pytest.raises(InputError, match="cannot be compared: 0 of 6 keyframes"):
        compare_exams(runs[0], other)


def test_sizes_are_in_mm_by_the_reference_of_the_first(
    runs: tuple[Path, Path], found: ExamComparison, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first = shutil.copytree(runs[0], tmp_path / "first")
    ends = np.array([[0.0, 0.0, PLANE_MM], [4.0, 0.0, PLANE_MM]])
    add_measurement(first, HandMeasure(".", 2, np.zeros((2, 2)), None, 10.0, [], ends, "reference"))
    referred = compare_exams(first, runs[1])
    factor = 10 / 4
    assert referred.registration.S_first_second.scale == pytest.approx(found.registration.S_first_second.scale * factor)
    np.testing.assert_allclose(referred.second.vertices, np.asarray(found.second.vertices) * factor, rtol=1e-6)
    for one, other in zip(referred.changes, found.changes, strict=True):
        assert one.area_mm2 == pytest.approx(other.area_mm2 * factor**2)
        assert one.rise_mm == pytest.approx(other.rise_mm * factor)
        np.testing.assert_allclose(one.place_mm, other.place_mm * factor)
    assert call("compare-exams", first, runs[1], "--out", tmp_path / "out") == 0
    (sizes,) = (line for line in capfd.readouterr().out.splitlines() if line.startswith("Sizes are those of first: "))
    assert "reference of 10 mm in frame 2" in sizes
    assert "unknown" not in sizes
    changes = json.loads((tmp_path / "out" / "changes.json").read_text())["changes"]
    assert changes[0]["area_mm2"] == pytest.approx(referred.changes[0].area_mm2)
    assert "area, mm²" in (tmp_path / "out" / "compare.html").read_text()
