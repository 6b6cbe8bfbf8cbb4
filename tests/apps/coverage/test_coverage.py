"""What was not seen, on shapes whose holes are known: a tube, a bent tube, a bowl."""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.apps.coverage.coverage import BLIND, CAUTION, NOT_SEEN, Coverage, coverage, regions
from scopemap.apps.coverage.layout import Cavity, Lumen, binned
from scopemap.apps.coverage.unseen import face_visibility, features
from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.centreline import Centreline, centreline, clock
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.engine.notices import Notice
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from scopemap.result.wording import facts_of_notices
from scopemap_bench.scripts import coverage as scoring
from tests.bench.evaluation.test_true_surface import write_coverage
from tests.support.drawn_run import CAMERA, changed, drawn_result, tube
from tests.support.front_door import call, refused

HOLE_AT, HOLE_CLOCK, HOLE_MM = 40.0, 3.0, 12.0


def write_run(folder: Path, mesh: trimesh.Trimesh, positions_mm: np.ndarray, **facts: object) -> Path:
    """Write a run whose surface is a mesh, and whose frames saw it from positions (N, 3), looking along z."""
    write, rows = DepthWriter(folder), []
    for index, position in enumerate(positions_mm):
        T = se3(np.eye(3), position)
        seen = render_mesh(mesh, CAMERA, T)
        write(Frame(index, index / 10, seen.rgb, CAMERA, np.isfinite(seen.depth_mm), seen.depth_mm, T))
        rows.append({"index": index, "time_s": index / 10, "map": 0, "status": "ok", "T_world_camera": T})
    config = Config.load(settings={"fusion.voxel_mm": 0.8})
    facts = {"frames": len(rows)} | facts
    changed(drawn_result(**facts), frames=FrameTable.of(rows), mesh=mesh, config=config, others=[]).save(folder)
    return folder


def without(mesh: trimesh.Trimesh, hidden: Callable[[np.ndarray], np.ndarray]) -> trimesh.Trimesh:
    """Return a mesh without the faces whose middles (F, 3) are hidden."""
    cut = mesh.copy()
    cut.update_faces(~hidden(mesh.triangles_center))
    cut.remove_unreferenced_vertices()
    return cut


def in_hole(points_mm: np.ndarray) -> np.ndarray:
    """Which points of the tube are in its hole: 12 mm long and wide, at 3 o'clock, which is x."""
    hours = clock(points_mm[:, 0], -points_mm[:, 1])
    along = np.abs(points_mm[:, 2] - HOLE_AT) < HOLE_MM / 2
    return along & (np.abs(hours - HOLE_CLOCK) * np.pi / 6 * 10 < HOLE_MM / 2)


ALONG_THE_TUBE = np.column_stack([np.zeros((30, 2)), np.linspace(-20, 70, 30)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("tube") / "run", tube(), ALONG_THE_TUBE)


@pytest.fixture(scope="module")
def holed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("holed") / "run", without(tube(), in_hole), ALONG_THE_TUBE)


@pytest.mark.slow
def test_a_hole_in_a_tube_is_found_where_it_is(whole: Path, holed: Path) -> None:
    found, full = coverage(holed), coverage(whole)
    assert isinstance(found.layout, Lumen)
    assert found.layout.radius_mm == pytest.approx(10, abs=1.5)
    # The near end of the tube is below the picture's edge.
    assert all(spot.position_mm[2] < 10 for spot in full.spots)
    [spot] = [spot for spot in found.spots if spot.position_mm[2] > 10]
    assert spot.position_mm == pytest.approx((10.0, 0.0, HOLE_AT), abs=2.5)
    assert spot.clock == pytest.approx(HOLE_CLOCK, abs=0.4)
    assert spot.area == pytest.approx(HOLE_MM**2, rel=0.4)
    begins = found.layout.line.points_mm[found.first, 2]
    assert begins + spot.along == pytest.approx(HOLE_AT, abs=2.5)
    assert spot.frame == np.argmin(np.abs(ALONG_THE_TUBE[:, 2] - HOLE_AT))
    assert spot.time_s == pytest.approx(spot.frame / 10)
    # The regression is as cautious about seen wall as about holes: a hole adds less than its share.
    hole = HOLE_MM**2 / (2 * np.pi * 10 * (found.total.end - found.total.start))
    assert 0.3 * hole < found.total.share - full.total.share < 1.3 * hole
    assert found.total.low < found.total.share < found.total.high
    around = [part for part in found.segments if part.start <= spot.along < part.end]
    assert around[0].share == max(part.share for part in found.segments[1:])


@pytest.mark.slow
def test_a_lid_over_an_open_end_is_no_wall(whole: Path, tmp_path: Path) -> None:
    bottom = 84.9  # the tube has one at its far end, which was seen
    opened = coverage(
        write_run(tmp_path / "run", without(tube(), lambda points: points[:, 2] > bottom), ALONG_THE_TUBE)
    )
    full = coverage(whole)

    def inside(found: Coverage) -> np.ndarray:
        middles = found.surface.triangles_center
        return middles[np.hypot(middles[:, 0], middles[:, 1]) < 8.5]

    # What is left within the wall, whose radius is 10, is the bottom: over open ends there is nothing.
    assert not len(inside(opened))
    assert inside(full)[:, 2].min() > bottom - 2
    # The other end is below the picture's edge; nothing else of the open tube was missed.
    assert all(spot.position_mm[2] < 10 for spot in opened.spots)
    assert opened.total.share == pytest.approx(full.total.share, abs=0.01)


def test_the_map_has_the_hole_and_its_table(holed: Path, tmp_path: Path) -> None:
    found = coverage(holed)
    chart = found.map
    rows, columns = np.nonzero(chart.spot == 1)
    assert (chart.classes[rows, columns] == NOT_SEEN).all()
    assert np.abs(columns - HOLE_CLOCK * 3 + 0.5).max() < 6
    # The surface has the classes of the map: a class that is on one is on the other.
    assert set(np.unique(found.classes)) == set(np.unique(chart.classes)) | {0}
    assert found.unseen_faces[
        np.linalg.norm(found.surface.triangles_center - found.spots[0].position_mm, axis=1).argmin()
    ]
    hidden = np.nansum(chart.area * chart.unseen) / np.nansum(chart.area)
    assert hidden == pytest.approx(found.total.share, abs=0.02)
    chart.write(tmp_path / "map.csv")
    table = list(csv.DictReader((tmp_path / "map.csv").open()))
    assert len(table) == np.isfinite(chart.unseen).sum()
    assert {row["class"] for row in table} <= {"1", "2", "3"}
    assert sum(float(row["area"]) for row in table) == pytest.approx(found.total.area, rel=0.02)
    assert any(float(row["unseen"]) > BLIND and row["spot"] == "1" for row in table)


def test_the_views_of_a_wall_are_those_of_geometry(whole: Path) -> None:
    run = Result(whole)
    views = face_visibility(run, run.mesh)
    middle = run.mesh.triangles_center
    ring = np.flatnonzero((np.abs(middle[:, 2] - 50) < 3) & (np.abs(middle[:, 0]) > 8))
    # At the edge of the picture, 53 or 47 degrees across, the camera is 15 or 19 mm behind the ring.
    assert views.distance_mm[ring].max() < 25
    assert views.cosine[ring].min() > 0.4
    assert views.cosine[ring].max() < 0.7
    assert (views.jump[ring] < 0.3).all()
    layout = Cavity(np.zeros(3), np.eye(3), 10.0)
    known = features(run.mesh, views, np.ones(len(middle), bool), layout)
    assert known.shape == (len(middle), 6)
    assert known[ring, 4] == pytest.approx(views.distance_mm[ring] / 10)


def test_the_centreline_of_a_bent_tube_is_its_arc() -> None:
    axis, radius, cell = 30.0, 7.0, 1.0
    corner = np.array([-10.0, -10.0, -10.0])
    x, y, z = (
        np.moveaxis(np.indices((52, 52, 20)) + 0.5, 0, -1).reshape(52, 52, 20, 3).transpose(3, 0, 1, 2) * cell - 10
    )
    away = np.hypot(np.hypot(x, y) - axis, z)
    line = centreline((away < radius) & (x > 0) & (y > 0), corner, cell)
    inner = line.points_mm[7:-7]
    assert np.hypot(inner[:, 0], inner[:, 1]) == pytest.approx(np.full(len(inner), axis), abs=2)
    assert np.abs(inner[:, 2]).max() < 1.5
    assert len(line.points_mm) * line.step_mm == pytest.approx(np.pi / 2 * axis, rel=0.2)
    assert line.radius_mm == pytest.approx(radius, abs=1.5)
    # From (30, 0) to (0, 30), with 12 o'clock up z; outwards is then at 3 o'clock.
    poses = np.array([se3(np.column_stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([axis, 5.0, 0.0]))])
    line = line.towards(poses, np.array([0.0, 0.0, 1.0]))
    turn = np.radians([20, 45, 70])
    outside = np.column_stack([36 * np.cos(turn), 36 * np.sin(turn), np.zeros(3)])
    place, hours = line.place(outside)
    assert (np.diff(place) > 5).all()
    assert hours == pytest.approx(np.full(3, 3.0), abs=0.5)


def test_the_clock_is_that_of_a_viewer() -> None:
    line = Centreline(np.column_stack([np.zeros((9, 2)), np.arange(9.0)]), 1.0, 5.0, np.array([0.0, -1.0, 0.0]))
    points = np.array([[0.0, -5, 4], [5, 0, 4], [0, 5, 4], [-5, 0, 4]])
    place, hours = line.place(points)
    assert place.tolist() == [4] * 4
    assert hours == pytest.approx([0, 3, 6, 9])
    cavity = Cavity(np.array([0.0, 0, 4 - 5]), np.diag([1.0, -1.0, 1.0]), 5.0)
    row, hours, wall = cavity.place(points, -points)
    assert (row * cavity.step).tolist() == [44] * 4
    assert hours == pytest.approx([0, 3, 6, 9])
    assert wall.all()


def test_regions_go_on_past_twelve() -> None:
    chosen = np.zeros((4, 36), bool)
    chosen[1, :3] = chosen[1, -2:] = chosen[3, 10] = True
    assert len(np.unique(regions(chosen))) == 3
    assert regions(chosen)[1, 0] == regions(chosen)[1, -1] > 0


def test_the_examined_part_ends_where_half_was_seen() -> None:
    line = Centreline(np.column_stack([np.zeros((6, 2)), np.arange(6.0)]), 1.0, 1.0, np.array([0.0, -1.0, 0.0]))
    area = binned(np.arange(6), np.zeros(6), np.full(6, 2.0), 6)
    seen = binned(np.arange(6), np.zeros(6), np.array([0.5, 0.5, 2.0, 0.5, 1.5, 2.0]), 6)
    assert np.flatnonzero(Lumen(line).examined(area, seen).any(1)).tolist() == [2, 3, 4]


def bowl() -> trimesh.Trimesh:
    """Return a part of a ball of 30 mm, up to 32 degrees from z, its faces towards its middle."""
    ball = trimesh.creation.icosphere(5, 30.0)
    ball.invert()
    return without(ball, lambda p: p[:, 2] < 30 * np.cos(np.radians(32)))


def in_bowls_hole(points_mm: np.ndarray) -> np.ndarray:
    """Which points are within 7.5 mm of the direction of 13 degrees at 6 o'clock, which is y."""
    turn = np.radians(13)
    return np.linalg.norm(points_mm - 30 * np.array([0, np.sin(turn), np.cos(turn)]), axis=1) < 7.5


def test_a_hole_in_a_bowl_is_found_in_its_direction(tmp_path: Path) -> None:
    sideways = np.column_stack([np.linspace(-6, 6, 12), np.zeros((12, 2))])
    found = coverage(write_run(tmp_path / "run", without(bowl(), in_bowls_hole), sideways))
    assert isinstance(found.layout, Cavity)
    spot = min(found.spots, key=lambda one: abs(one.along - 13))
    assert spot.along == pytest.approx(13, abs=5)
    assert spot.clock == pytest.approx(6, abs=0.5)
    assert 0.3 < spot.area / (np.pi * 7.5**2) < 1
    assert "from the mean direction of view" in str(found)


@pytest.mark.slow
def test_the_command_writes_figures_map_and_picture(holed: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert call("coverage", holed) == 0
    said = capfd.readouterr().out
    assert "3 o'clock" in said
    assert "scale unknown" in said
    assert re.search(r" of \d+ square units of a lumen", said)
    assert "unit2" not in said
    colours = trimesh.load(holed / "coverage" / "coverage.ply", process=False).visual.face_colors
    share = (colours[:, 0] > 150) & (colours[:, 1] < 60)
    assert 0 < share.mean() < 0.5  # the hole is red
    facts = json.loads((holed / "coverage" / "coverage.json").read_text())
    assert set(facts) == {
        "kind",
        "unit",
        "along_unit",
        "scale",
        "statement",
        "caution",
        "total",
        "segments",
        "blind_spots",
    }
    assert (facts["kind"], facts["unit"], len(facts["blind_spots"]) > 0) == ("lumen", "unit", True)
    picture = cv2.imread(str(holed / "coverage" / "map.png"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    assert "exists" in refused(capfd, "coverage", holed)
    spots = holed / "spots.mrk.json"
    assert call("coverage", holed, "--overwrite", "--json", "--export", spots) == 0
    [points] = json.loads(spots.read_text())["markups"]
    assert [point["position"] for point in points["controlPoints"]] == [
        one["position_mm"] for one in facts["blind_spots"]
    ]
    assert json.loads(capfd.readouterr().out)["total"] == facts["total"]


def test_what_says_nothing_about_coverage_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no finished run" in refused(capfd, "coverage", tmp_path)
    flat = write_run(tmp_path / "flat", trimesh.Trimesh(), ALONG_THE_TUBE[:12])
    assert "no surface" in refused(capfd, "coverage", flat)
    blind = write_run(tmp_path / "blind", tube(), ALONG_THE_TUBE[:12])
    for file in (blind / "depth").iterdir():
        file.unlink()
    assert "no depth" in refused(capfd, "coverage", blind)
    bad = write_run(tmp_path / "bad", tube(), ALONG_THE_TUBE[:2])
    with pytest.raises(InputError, match="not usable"):
        coverage(bad)


def test_a_known_scale_gives_millimetres(tmp_path: Path) -> None:
    known = {"known": True, "measured": True, "source": "measured depth"}
    run = write_run(tmp_path / "run", tube(), ALONG_THE_TUBE[::2], scale=known)
    found: Coverage = coverage(run)
    assert found.facts["unit"] == found.facts["along_unit"] == "mm"


@pytest.mark.slow
def test_an_assumed_lens_and_moving_tissue_are_a_caution(holed: Path, tmp_path: Path) -> None:
    moved = {"frames": 20, "measured": 30, "most": 3.0, "share": 0.5, "threshold": 0.1, "x": 0.5, "y": 0.5}
    assumed = {"camera": drawn_result().provenance["camera"] | {"origin": "assumed"}}
    moving = {"notices": facts_of_notices([Notice("tissue-moves", moved)])}
    for number, (facts, is_said) in enumerate([(assumed, False), (moving, False), (assumed | moving, True)]):
        run = write_run(tmp_path / f"{number}", without(tube(), in_hole), ALONG_THE_TUBE, **facts)
        found = coverage(run)
        assert (found.caution, found.facts["caution"]) == ((CAUTION,) * 2 if is_said else ("",) * 2), facts
        assert (CAUTION in str(found)) == is_said


def write_truth(folder: Path, positions_mm: np.ndarray) -> Path:
    """C3VD's truth of the tube, twice as large: its hole was missed, and all of a tube beside it."""
    folder.mkdir()
    R, t, wall = so3_exp(np.array([0.3, -0.2, 0.5])), np.array([5.0, -8.0, 20.0]), tube()
    beside = wall.copy().apply_translation([70.0, 0, 0])
    mesh = trimesh.util.concatenate([wall, beside])
    observed = np.concatenate([~in_hole(wall.triangles_center), np.zeros(len(beside.faces), bool)])
    mesh.vertices = 2 * mesh.vertices @ R.T + t
    write_coverage(folder / "coverage_mesh.obj", mesh, observed)
    # Its poses are transposed.
    rows = [se3(R, 2 * R @ position + t).T.ravel() for position in positions_mm]
    np.savetxt(folder / "pose.txt", rows, fmt="%.9g", delimiter=",")
    return folder


@pytest.mark.slow
def test_a_result_is_measured_against_c3vds_coverage_mesh(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    around = np.linspace(0, 3 * np.pi, 30)
    positions = ALONG_THE_TUBE + np.column_stack([np.cos(around), np.sin(around), np.zeros(30)])
    run = write_run(tmp_path / "run", without(tube(), in_hole), positions)
    with pytest.raises(InputError, match=r"holds no coverage_mesh\.obj"):
        scoring.of_c3vd(run, tmp_path)
    name, found, errors = scoring.of_c3vd(run, write_truth(tmp_path / "tube_t1_a", positions))
    hole = HOLE_MM**2 / (2 * np.pi * 10 * (found.total.end - found.total.start))
    assert errors.share == pytest.approx(hole, rel=0.15)
    place = HOLE_AT - found.layout.line.points_mm[found.first, 2]
    assert np.argmax(errors.segments) == np.argmax([part.end > place for part in found.segments])
    assert sum(share > 0 for share in errors.segments) <= 2
    assert errors.found == [True]
    assert sum(errors.right) == 1
    monkeypatch.setattr(sys, "argv", ["coverage", "--c3vd", str(run), str(tmp_path / name)])
    scoring.main()
    row = capfd.readouterr().out.splitlines()[2]
    estimated = f"{found.total.share:.1%} ({found.total.low:.0%} to {found.total.high:.0%})"
    assert row.startswith(f"| tube_t1_a | {errors.share:.1%} | {estimated} | ")
    assert row.endswith("| 1 of 1 |")
