"""Camera calibration: known cameras are found again from rendered views, and what cannot serve is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.apps.calibrate.camera_calibration import (
    FORMS,
    CameraCalibration,
    LensForm,
    calibrate,
    fit_camera,
    save_calibration,
    warnings_about,
    with_deviations,
)
from scopemap.apps.calibrate.targets import (
    CharucoBoard,
    Checkerboard,
    Corners,
    DetectedBoard,
    Search,
    Target,
    edge_width_px,
    nearest_px,
)
from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from tests.support.drawn_boards import CHECKERBOARD, FISHEYE, PINHOLE, SIZE, Studio

pytestmark = pytest.mark.slow

CHARUCO = CharucoBoard(7, 5, 4.0, 3.0)
WRONG, BLURRED = 100, 101


def searched(board: Target, pictures: dict[int, np.ndarray]) -> Search:
    search = Search(SIZE)
    for index, picture in pictures.items():
        grey = picture[..., 0]
        corners = board.find(grey)
        search.looked_at += 1
        if corners is not None:
            width_px = edge_width_px(grey, corners.pixels)
            search.views.append(DetectedBoard(index, f"{index}.png", corners, width_px))
    return search


def pictures(camera: CameraModel, board: Checkerboard | CharucoBoard, count: int) -> dict[int, np.ndarray]:
    studio = Studio(camera, board)
    return {i: studio.shot(pose, seed=i) for i, pose in enumerate(studio.poses(count))}


@pytest.fixture(scope="module")
def pinhole_search() -> Search:
    """Views of a checkerboard, one of them of a board whose squares are no squares, one out of focus."""
    taken = pictures(PINHOLE, CHECKERBOARD, 18)
    studio = Studio(PINHOLE, CHECKERBOARD)
    pose = list(studio.poses(8))[7]
    taken[BLURRED] = studio.shot(pose, blur_px=1.8)
    studio.print = cv2.resize(studio.print, None, fx=1.0, fy=0.9)
    taken[WRONG] = studio.shot(pose)
    return searched(CHECKERBOARD, taken)


@pytest.fixture(scope="module")
def pinhole(pinhole_search: Search) -> CameraCalibration:
    return calibrate(pinhole_search, CHECKERBOARD)


@pytest.fixture(scope="module")
def fisheye() -> CameraCalibration:
    return calibrate(searched(CHECKERBOARD, pictures(FISHEYE, CHECKERBOARD, 16)), CHECKERBOARD)


@pytest.fixture(scope="module")
def charuco() -> CameraCalibration:
    return calibrate(searched(CHARUCO, pictures(PINHOLE, CHARUCO, 16)), CHARUCO, "pinhole")


def bend_px(camera: CameraModel, rays: np.ndarray) -> np.ndarray:
    return camera.project(rays) - camera.central.project(rays)


@pytest.mark.parametrize(
    ("name", "truth", "off_px", "bend_rms_px"),
    [("pinhole", PINHOLE, 0.5, 0.15), ("fisheye", FISHEYE, 0.5, 0.3), ("charuco", PINHOLE, 1.5, 0.5)],
)
def test_a_known_camera_is_found_again(
    name: str, truth: CameraModel, off_px: float, bend_rms_px: float, request: pytest.FixtureRequest
) -> None:
    done: CameraCalibration = request.getfixturevalue(name)
    found, true = done.fit.camera.central, truth.central
    assert type(done.fit.camera) is type(truth)
    assert abs(found.fx / true.fx - 1) < 0.005
    assert abs(found.fy / true.fy - 1) < 0.005
    assert np.hypot(found.cx - true.cx, found.cy - true.cy) < off_px
    rays = truth.unproject(np.stack(np.meshgrid(np.arange(8, SIZE[0], 8), np.arange(8, SIZE[1], 8)), -1))
    rays = rays[np.hypot(rays[..., 0], rays[..., 1]) < 2]  # up to 63 deg from the axis
    off = bend_px(done.fit.camera, rays) - bend_px(truth, rays)
    assert np.sqrt(np.mean(np.sum(off**2, axis=-1))) < bend_rms_px
    assert done.fit.rms_px < 0.12


def test_deviations_are_as_large_as_errors_also_where_the_plate_bends() -> None:
    studio, form, shares = Studio(PINHOLE, CHECKERBOARD), LensForm("pinhole", ("k1", "k2", "p1", "p2")), []
    true = np.array(
        [getattr(PINHOLE.central, name) for name in ("fx", "fy", "cx", "cy")] + list(PINHOLE.distortion[:4])
    )
    for seed in range(8):
        rng, views = np.random.default_rng(seed), []
        for i, pose in enumerate(studio.poses(12, seed=seed)):
            # By so much the plate bends from view to view: errors of the corners of one view are alike.
            pixels = studio.corners_px(pose, bow_mm=rng.normal(0, 0.05))
            corners = Corners(CHECKERBOARD.corners_mm, pixels + rng.normal(0, 0.05, pixels.shape))
            views.append(DetectedBoard(i, "", corners, 1.0))
        fit = with_deviations(fit_camera(views, SIZE, form, near=PINHOLE), views)
        off = np.array(list(fit.parameters.values())) - true
        shares.append(off / np.array(list(fit.deviations.values())))
    # 64 errors over their deviations; those that the noise of single corners gives were 2.3 times too small.
    assert 0.7 < np.sqrt(np.mean(np.square(shares))) < 1.3
    assert np.mean(np.abs(shares) < 2) > 0.9


def test_the_wrong_and_the_blurred_view_are_left_out_with_the_reason(
    pinhole_search: Search, pinhole: CameraCalibration
) -> None:
    assert {WRONG, BLURRED} <= {view.index for view in pinhole_search.views}
    reasons = {out.view.index: out.reason for out in pinhole.left_out}
    assert reasons[WRONG].startswith("it does not fit: ")
    assert len(reasons) <= 3
    assert pinhole.blurred[0].reason.startswith("blurred: its edges are ")
    assert BLURRED in {out.view.index for out in pinhole.blurred}


def test_the_model_and_no_more_coefficients_than_needed_are_chosen(
    pinhole: CameraCalibration, fisheye: CameraCalibration
) -> None:
    assert pinhole.fit.form == LensForm("pinhole", ("k1", "k2", "p1", "p2"))
    assert fisheye.fit.form.model == "fisheye"
    assert list(pinhole.held_out_px) == list(FORMS)
    best_other = min(error for form, error in fisheye.held_out_px.items() if form.model == "pinhole")
    assert best_other > 3 * fisheye.held_out_px[fisheye.fit.form]
    # A view that was held out finds its pose again: no form of the right model is far off.
    assert max(error for form, error in pinhole.held_out_px.items() if form.model == "pinhole") < 1


def test_the_summary_says_where_the_boards_were(pinhole: CameraCalibration) -> None:
    truth = dict(enumerate(Studio(PINHOLE, CHECKERBOARD).poses(18)))
    facts = pinhole.summary()
    assert len(facts["views"]) == len(pinhole.views) >= 12
    for view in facts["views"]:
        pose = truth[view["frame"]]
        centre = pose[:3, :3] @ [15.0, 10.5, 0] + pose[:3, 3]
        assert view["distance_mm"] == pytest.approx(centre[2], rel=0.01)
        assert view["tilt_deg"] == pytest.approx(np.degrees(np.arccos(pose[2, 2])), abs=1)
    assert 0.5 < facts["coverage"] < 0.9


# ---- selection


@pytest.mark.parametrize(
    ("views", "words"),
    [
        ([0] * 30, r"found in 30 of 30 frames, but 1 of these views .* at least 8 needed: move"),
        ([0, 1], r"found in 2 of 2 frames, at least 8 needed: looked for a checkerboard of 9"),
    ],
)
def test_too_few_views_that_differ_are_refused(pinhole_search: Search, views: list[int], words: str) -> None:
    few = [replace(pinhole_search.views[view], index=place) for place, view in enumerate(views)]
    with pytest.raises(InputError, match=words):
        calibrate(replace(pinhole_search, views=few, looked_at=len(few)), CHECKERBOARD)


def test_stray_corners_go_and_shortcomings_are_said(pinhole_search: Search, pinhole: CameraCalibration) -> None:
    spoiled = [*pinhole.views]
    for place, view in enumerate(spoiled[:3]):
        pixels = view.corners.pixels + np.where(np.arange(len(view.corners))[:, None] < 2, [7.0, -4.0], 0.0)
        spoiled[place] = replace(view, corners=Corners(view.corners.board_mm, pixels))
    done = calibrate(replace(pinhole_search, views=spoiled), CHECKERBOARD, "pinhole")
    assert [view.index for view in done.views] == [view.index for view in pinhole.views]
    assert all(
        len(view.corners) <= len(whole.corners) - 2 for view, whole in zip(done.views[:3], spoiled, strict=False)
    )
    assert done.fit.camera.central.fx == pytest.approx(pinhole.fit.camera.central.fx, rel=1e-3)
    flat = np.tile(np.eye(4), (len(done.views), 1, 1))
    rough = tuple(100 * residual for residual in done.fit.residuals_px)
    poor = replace(done.fit, T_camera_board=flat, residuals_px=rough, deviations=done.fit.deviations | {"fx": 10.0})
    said = "\n".join(warnings_about(poor, 0.3))
    for words in ("in 0 view(s)", "cover 30 %", "px off on the whole", "known to 3.8 % only"):
        assert words in said


# ---- what cannot serve


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Checkerboard(2, 6, 3.0), "2x6 cannot be"),
        (lambda: Checkerboard(9, 6, float("nan")), "larger than 0 mm"),
        (lambda: CharucoBoard(7, 5, 4.0, 4.0), "does not fit a square"),
        (lambda: CharucoBoard(7, 5, 4.0, 3.0, "DICT_3X3"), "unknown markers 'DICT_3X3': choose one of DICT_4X4_100,"),
        (lambda: CharucoBoard(14, 10, 4.0, 3.0), "has 70 markers, DICT_4X4_50 only 50"),
    ],
)
def test_a_board_that_cannot_be(make: object, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        make()  # type: ignore[operator]


@pytest.mark.parametrize("blur_px", [0.6, 2.0])
def test_corners_of_large_pictures_are_where_they_truly_are(blur_px: float, large: Studio) -> None:
    """Squares of 90 px, whose edges the lens bends: a search in a small picture, then a window that spans little."""
    off = []
    for i, (tilt, turn, left_mm, down_mm) in enumerate(((0.2, -0.3, -3, -2), (-0.3, 0.1, 3, 2), (0.1, 0.3, 2, -2))):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([tilt, turn, 0.1]))[0]
        pose[:3, 3] = pose[:3, :3] @ [-15, -10.5, 0] + [left_mm, down_mm, 25]
        found = CHECKERBOARD.find(large.shot(pose, seed=i, blur_px=blur_px)[..., 0])
        assert found is not None
        assert nearest_px(found.pixels) > 60
        true = large.corners_px(pose)
        both_ways = (np.linalg.norm(found.pixels - way, axis=1) for way in (true, true[::-1]))
        off.append(min(both_ways, key=np.sum))
    assert np.sqrt(np.mean(np.square(off))) < 0.05 * max(blur_px, 1)
    assert np.max(off) < 0.15 * max(blur_px, 1)


@pytest.fixture(scope="module")
def large() -> Studio:
    camera = OpenCvCamera(PinholeCamera(700.0, 700.0, 640.0, 480.0, 1280, 960), (-0.28, 0.08, 0.0, 0.0))
    return Studio(camera, CHECKERBOARD, samples=1)


# ---- what is left open


def test_a_camera_that_commands_would_refuse_is_not_written(pinhole: CameraCalibration, tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text("the earlier one")
    narrow = replace(pinhole, fit=replace(pinhole.fit, camera=PinholeCamera(9000.0, 9000.0, 160, 120, *SIZE)))
    with pytest.raises(CalibrationError, match="no file was written: the fitted camera does not fit"):
        save_calibration(narrow, file)
    assert [each.read_text() for each in tmp_path.iterdir()] == ["the earlier one"]
