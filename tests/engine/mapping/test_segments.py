"""Segments: where a scene changes, each part of the time has a correction, a surface and a verdict of its own."""

from __future__ import annotations

import itertools
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.apps.export.formats import export_run
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, MappingSettings
from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import read_mesh
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, se3, so3_exp, transform
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Points, Priors
from scopemap.engine.mapping.correction import FrameCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.judge import Interval
from scopemap.engine.mapping.keyframes import MapKeyframes
from scopemap.engine.mapping.segments import choose_segments, joined
from scopemap.engine.notices import Level, Notice
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from scopemap.result.surface_segments import SurfaceSegment, main_segment, read_segments, write_segments
from scopemap.result.verdict import Reason, graded, verdict
from scopemap.result.wording import facts_of_notices

CAMERA = PinholeCamera(200.0, 200.0, 159.5, 119.5, 320, 240)
COUNT = 17
CHANGE = 8
"""Keyframe from which on the tissue has another shape."""


def _poses() -> np.ndarray:
    """A camera that moves sideways and turns a little: T_world_camera (K, 4, 4), mm."""
    return np.stack([se3(so3_exp(np.array([0, 0.01 * k, 0])), np.array([3.0 * k, 0.5 * k, 0])) for k in range(COUNT)])


def _scene(moved_mm: float, noise_px: float = 0.1) -> tuple[MapKeyframes, BundleProblem]:
    """Keyframes before a rough wall that bulges by up to so much, some of it towards and some away, at one keyframe."""
    rng, T_world_camera = np.random.default_rng(4), _poses()
    host, pixel, log_depth, point, observer, observed = [], [], [], [], [], []
    for k in range(COUNT):
        seen = rng.uniform([0, 0], [320, 240], (120, 2))
        depth_mm = rng.uniform(80, 120, 120)
        at = transform(T_world_camera[k], CAMERA.unproject(seen) * depth_mm[:, None])
        bulge = moved_mm * np.column_stack([np.sin(at[:, 1] / 15), np.sin(at[:, 0] / 15), np.cos(at[:, 0] / 12)])
        for other in range(max(k - 3, 0), min(k + 4, COUNT)):
            change = (other >= CHANGE) - (k >= CHANGE)
            then = at + change * bulge
            there = CAMERA.project(transform(inverse(T_world_camera[other]), then))
            inside = ((there >= 0) & (there < [320, 240])).all(1) if other != k else np.zeros(120, bool)
            point.append(np.flatnonzero(inside) + 120 * k)
            observer.append(np.full(inside.sum(), other))
            observed.append(there[inside] + rng.normal(0, noise_px, (inside.sum(), 2)))
        host.append(np.full(120, k))
        pixel.append(seen)
        log_depth.append(np.log(depth_mm * rng.normal(1, 0.02, 120)))
    centre = np.array([CAMERA.cx, CAMERA.cy])
    order = np.argsort(np.concatenate(point), kind="stable")
    seen_at = Observations(*(np.concatenate(part)[order] for part in (point, observer, observed)))
    points = Points(
        np.concatenate(host), np.concatenate(pixel) - centre, np.concatenate(log_depth), np.full(120 * COUNT, 0.1)
    )
    pairs = np.arange(COUNT - 1)[:, None] + [0, 1]
    observations = replace(seen_at, pixel=seen_at.pixel - centre)
    problem = BundleProblem(inverse(T_world_camera), points, observations, Priors(), pairs, CAMERA.fx)
    grid = np.full((30, 40), 100.0, np.float32)
    after = grid.copy()
    after *= np.exp(0.01 * moved_mm * np.cos(np.arange(40) / 3))[None].astype(np.float32)
    keyframes = MapKeyframes(
        index=10 * np.arange(COUNT),
        poses=[TrackedPose(0, 10 * max(k - 1, 0), T) for k, T in enumerate(T_world_camera)],
        steps=[KeyframeStep()] * COUNT,
        log_drift=np.zeros(COUNT),
        grids_mm=np.stack([grid if k < CHANGE else after for k in range(COUNT)]),
        S_common_map={0: Similarity.identity()},
        camera=CAMERA,
        settings=MappingSettings(),
    )
    return keyframes, problem


def _ends(intervals: list[Interval]) -> list[tuple[int, int]]:
    return [(interval.first, interval.last) for interval in intervals]


def test_a_scene_that_holds_still_is_one_segment() -> None:
    assert _ends(choose_segments(*_scene(0.0))) == [(0, COUNT - 1)]


def test_where_tissue_moves_a_segment_ends() -> None:
    found = choose_segments(*_scene(30.0))
    assert len(found) > 1
    assert (found[0].first, found[-1].last) == (0, COUNT - 1)
    assert all(one.last == other.first for one, other in itertools.pairwise(found))
    # No segment but the piece with the change in it reaches from before it to well after it.
    assert not [one for one in found if one.first < CHANGE - 4 and one.last > CHANGE + 4]
    rigid = [one for one in found if one.last < CHANGE or one.first >= CHANGE]
    assert rigid
    assert max(one.error_px for one in rigid) < 0.3


def _correction(scale: float, shift_mm: float) -> FrameCorrection:
    """A correction that moves all frames, and scales their depth."""
    T = se3(so3_exp(np.array([0.0, 0.0, 0.1 * shift_mm])), np.array([shift_mm, -shift_mm, 2 * shift_mm]))
    index = 10 * np.arange(COUNT)
    return FrameCorrection(
        index, np.tile(T, (COUNT, 1, 1)), np.full(COUNT, np.log(scale)), 0.2, S_common_map={0: Similarity.identity()}
    )


def test_neighbours_share_a_keyframe_so_that_the_path_has_no_steps() -> None:
    keyframes, _ = _scene(0.0)
    intervals = [Interval(*ends, 0.2, 0.3, 0.01, 0.02) for ends in ((0, 6), (6, 12), (12, COUNT - 1))]
    segments = joined([_correction(1.0, 0.5), _correction(1.3, -2.0), _correction(0.8, 1.0)], intervals, keyframes)
    assert [segment.last for segment in segments] == [60, 120, 160]
    assert all(segment.is_joined for segment in segments)
    depth_mm = np.full((30, 40), 100.0)
    for (one, other), k in zip(itertools.pairwise(segments), (6, 12), strict=True):
        assert one.correction is not None
        assert other.correction is not None
        T = keyframes.poses[k].T_world_camera
        np.testing.assert_allclose(other.correction.pose(10 * k, T), one.correction.pose(10 * k, T), atol=1e-9)
        factors = (each.correction.depth_factors(10 * k, depth_mm) for each in (one, other))
        np.testing.assert_allclose(*factors, rtol=1e-6)


def test_segments_in_another_world_keep_their_shape() -> None:
    keyframes, _ = _scene(0.0)
    intervals = [Interval(*ends, 0.2, 0.3, 0.01, 0.02) for ends in ((0, 6), (6, COUNT - 1))]
    *_, last = joined([_correction(1.0, 0.5), _correction(1.3, -2.0)], intervals, keyframes)
    assert last.correction is not None
    T_new_world = se3(so3_exp(np.array([0.3, -0.2, 0.5])), np.array([5.0, 6.0, 7.0]))
    moved = last.correction.in_world(T_new_world)
    for index, pose in ((100, 10), (130, 13)):
        T = keyframes.poses[pose].T_world_camera
        np.testing.assert_allclose(moved.pose(index, T), T_new_world @ last.correction.pose(index, T), atol=1e-9)


def _square(z_mm: float) -> trimesh.Trimesh:
    corners = np.array([[-1, -1, z_mm], [1, -1, z_mm], [1, 1, z_mm], [-1, 1, z_mm]], float)
    colours = np.full((4, 4), 200, np.uint8)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], vertex_colors=colours, process=False)


FACTS = [
    {"first_frame": 0, "last_frame": 19, "start_s": 0.0, "end_s": 1.9, "frames": 20, "error": 0.21},
    {"first_frame": 20, "last_frame": 59, "start_s": 2.0, "end_s": 5.9, "frames": 40, "error": 0.012},
    {"first_frame": 60, "last_frame": 79, "start_s": 6.0, "end_s": 7.9, "frames": 20, "error": 0.014},
]


def _facts() -> list[dict[str, object]]:
    known = {
        "coverage_mean": 0.95,
        "coverage_least": 0.9,
        "within_10_percent_mean": 0.9,
        "within_10_percent_least": 0.8,
    }
    return [
        {name: value for name, value in facts.items() if name != "error"}
        | {"surface": known | {"depth_error": facts["error"]}, "faces": 2, "notices": [], "joined": True}
        for facts in FACTS
    ]


def segmented_result() -> Result:
    """A result with three segments, the first not usable."""
    segment = np.repeat([0, 1, 2], [20, 40, 20])
    rows = [
        {
            "index": k,
            "time_s": k / 10,
            "status": "ok" if k else "initial",
            "segment": segment[k],
            "T_world_camera": np.eye(4),
        }
        for k in range(80)
    ]
    segments = graded(facts := _facts())
    provenance = {
        "segments": facts,
        "main_segment": main_segment(segments),
        "surface": facts[1]["surface"],
        "notices": [],
        "camera": {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
    }
    meshes = [_square(z_mm) for z_mm in (10.0, 20.0, 30.0)]
    result = Result.in_memory(CAMERA, FrameTable.of(rows), meshes[1], Config(), provenance)
    return result.with_segments(segments, meshes)


def test_the_main_segment_is_the_longest_of_the_best_grade() -> None:
    assert [one.level for one in graded(_facts())] == ["bad", "good", "good"]
    assert main_segment(graded(_facts())) == 1
    of_one_level = [
        SurfaceSegment(0, 0, 90, 0.0, 9.0, "doubtful", 0.12, 0.4),
        SurfaceSegment(1, 91, 120, 9.1, 12.0, "doubtful", 0.02, 0.8),
    ]
    assert main_segment(of_one_level) == 1


def test_a_few_frames_confirm_no_shape() -> None:
    few = [facts | {"frames": 9} for facts in _facts()]
    assert [one.level for one in graded(few)] == ["bad", "doubtful", "doubtful"]


def test_the_verdict_says_what_is_usable_and_when() -> None:
    found = verdict(segmented_result())
    assert found.advice.startswith("Usable: 2.0 to 7.9 s, 75 % of the video.")
    assert found.sentence.startswith("Usable: 2.0 to 7.9 s, 75 % of the video. 80 of 80 frames are in the result. ")
    (counted,) = (reason for reason in found.reasons if reason.code == "frames-in-result")
    assert "60 of 80" in counted.text
    assert {reason.code for reason in found.reasons if reason.level == "note"} >= {"segments"}


def test_the_verdict_names_the_good_segments_where_they_differ() -> None:
    def reasons_of(*levels: Level) -> tuple[str, dict[str, Reason]]:
        result = segmented_result()
        segments = [replace(one, level=level) for one, level in zip(result.segments, levels, strict=True)]
        moves = {"frames": 10, "measured": 80, "most": 3, "share": 0.2, "threshold": 3.0, "x": 1.0, "y": 1.0}
        result.provenance["notices"] = facts_of_notices([Notice("tissue-moves", moves)])
        found = verdict(result.with_segments(segments, [_square(10.0)] * 3))
        return found.advice, {reason.code: reason for reason in found.reasons}

    advice, reasons = reasons_of("doubtful", "good", "doubtful")
    assert advice.startswith("Usable: 0.0 to 7.9 s (good: 2.0 to 5.9 s), 100 % of the video.")
    assert reasons["tissue-moves"].next_step == "Use the good segments: 2.0 to 5.9 s."
    assert "(1 good, 2 doubtful). Good: 2.0 to 5.9 s." in reasons["segments"].text
    for alike in ("doubtful", "good"):
        advice, reasons = reasons_of(alike, alike, alike)
        assert "good:" not in advice
        assert reasons["tissue-moves"].next_step == ""
        assert "Good:" not in reasons["segments"].text
    # Without a good one there is nothing to recommend; what may be looked at is in the advice.
    assert reasons_of("doubtful", "bad", "bad")[1]["tissue-moves"].next_step == ""


def test_a_result_keeps_the_surface_of_every_segment(tmp_path: Path) -> None:
    segmented_result().save(tmp_path)
    again = Result(tmp_path)
    assert again.segments == graded(_facts())
    assert again.frames["segment"].tolist() == np.repeat([0, 1, 2], [20, 40, 20]).tolist()
    for index, z_mm in ((5, 10.0), (40, 20.0), (70, 30.0)):
        np.testing.assert_allclose(again.mesh_at(index).vertices[:, 2], z_mm)
    np.testing.assert_allclose(again.mesh.vertices[:, 2], 20.0)


def test_the_surfaces_are_shown_one_after_the_other(tmp_path: Path) -> None:
    segmented_result().save(tmp_path)
    glb = (tmp_path / "mesh_over_time.glb").read_bytes()
    (length,) = struct.unpack_from("<I", glb, 12)
    tree, binary = json.loads(glb[20 : 20 + length]), glb[28 + length :]

    def values(number: int) -> np.ndarray:
        about = tree["accessors"][number]
        view = tree["bufferViews"][about["bufferView"]]
        return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(about["count"], -1)

    (animation,) = tree["animations"]
    shown = [values(sampler["output"])[:, 0] for sampler in animation["samplers"]]
    np.testing.assert_allclose(values(animation["samplers"][0]["input"]).ravel(), [0.0, 2.0, 6.0], atol=1e-6)
    np.testing.assert_array_equal(shown, np.eye(3))
    scene = trimesh.load(tmp_path / "mesh_over_time.glb")
    assert len(scene.geometry) == 3


def test_the_surface_that_fits_each_frame_is_exported(tmp_path: Path) -> None:
    (result := segmented_result()).save(run := tmp_path / "run")
    export_run(run, "surfaces", tmp_path / "out", unit="m", axes="ras")
    assert len(list((tmp_path / "out").iterdir())) == 80
    for index, z_mm in ((5, 10.0), (40, 20.0), (70, 30.0)):
        vertices = np.asarray(read_mesh(tmp_path / "out" / f"{index:06d}.ply").vertices)
        np.testing.assert_allclose(vertices, result.mesh_at(index).vertices * [-0.001, -0.001, 0.001], atol=1e-6)
        np.testing.assert_allclose(vertices[:, 2], 0.001 * z_mm, atol=1e-6)
    result.with_segments([], []).save(tmp_path / "rigid")
    with pytest.raises(InputError, match="one surface fits all frames"):
        export_run(tmp_path / "rigid", "surfaces", tmp_path / "none")


def test_a_damaged_table_of_segments_is_refused(tmp_path: Path) -> None:
    write_segments(graded(_facts()), tmp_path)
    file = tmp_path / "surfaces" / "segments.csv"
    assert read_segments(tmp_path) == graded(_facts())
    file.write_text(file.read_text().replace("good", "fine"))
    with pytest.raises(InputError, match="no level is called 'fine'"):
        read_segments(tmp_path)
    assert read_segments(tmp_path / "elsewhere") == []
