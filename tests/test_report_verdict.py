"""The rules by which a run is good, doubtful or not usable; docs/report.md states the same thresholds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from drawn_run import GOOD_SURFACE, tube

from scopemap.report import verdict as rules
from scopemap.report.kept_run import LOST, NOT_USED, OTHER_MAP, KeptMap, KeptRun
from scopemap.report.submap_summaries import doubt_words, most_doubtful, submaps_in_time
from scopemap.report.verdict import longest_segment, scale_is_known, verdict

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "report.md"


def run_of(place: list[int], *, mesh: trimesh.Trimesh | None = None, **facts: Any) -> KeptRun:
    provenance = {
        "camera": {"source": "calibration file camera.yaml"},
        "estimators": {"anchor": "millimetres as scopenet gives them"},
        "notes": [],
        "surface": GOOD_SURFACE,
    } | facts
    maps = [KeptMap(np.arange(3), np.tile(np.eye(4), (3, 1, 1)), tube() if mesh is None else mesh)]
    return KeptRun(
        None, [{"index": str(i), "time_s": str(i / 10)} for i in range(len(place))], maps, np.array(place), provenance
    )


def surface(**figures: float) -> dict[str, float]:
    return GOOD_SURFACE | figures


def test_a_whole_run_is_good_and_its_sizes_are_unknown() -> None:
    found = verdict(run_of([0] * 100))
    assert found.word == "good"
    assert found.sentence == "100 of 100 frames in one map; scale unknown; surface covers 94 % of what was seen"
    assert [reason.level for reason in found.reasons] == ["good", "good", "good"]
    assert found.advice == "The shape can be used. Sizes are unknown: compare shapes, do not measure."


def test_what_a_result_may_be_used_for() -> None:
    known = {"scale": {"known": True, "source": "measured depth"}}
    assert verdict(run_of([0] * 50, **known)).advice.endswith("can be used. Sizes are known (by measured depth).")
    assert verdict(run_of([0] * 50 + [LOST] * 50)).advice.startswith("Use it with care: read the cautions first.")
    assert verdict(run_of([0] * 5)).advice == "Do not use this result."


def test_warnings_come_first_in_plain_words_and_once() -> None:
    said_elsewhere = [
        "10 submaps: the camera was lost, and nothing connects what it saw before and after; 77 of 181 tracked frames",
        "interrupted at frame 30: the result is of the frames until then",
    ]
    other = "the video a.mp4 holds 3 damaged picture(s), which were left out"
    warnings = [*said_elsewhere, other, other, "masks: 40 of 50 frames have none in masks; the last number in a mask's"]
    found = verdict(run_of([0] * 40 + [LOST] * 10, warnings=warnings, interrupted_at_frame=30))
    assert [(reason.level, reason.text) for reason in found.reasons[:3]] == [
        ("doubtful", "The run was stopped at frame 30: the rest is missing."),
        ("doubtful", "Most frames have no mask: instruments may be part of the surface."),
        ("note", "The video a.mp4 holds 3 damaged picture(s), which were left out."),
    ]
    assert any(reason.text.startswith("80 % of the frames until then are in the result") for reason in found.reasons)
    assert not any("submaps" in reason.text or "interrupted" in reason.text for reason in found.reasons)
    assert "damaged" not in " ".join(reason.text for reason in verdict(run_of([0] * 50)).reasons)


@pytest.mark.parametrize(
    ("inside", "word"), [(100, "good"), (80, "good"), (79, "doubtful"), (30, "doubtful"), (29, "not usable")]
)
def test_the_share_of_frames_in_the_result(inside: int, word: str) -> None:
    assert verdict(run_of([0] * inside + [LOST] * (100 - inside))).word == word


@pytest.mark.parametrize(
    ("figures", "word"),
    [
        (surface(coverage_mean=0.8), "good"),
        (surface(coverage_mean=0.79), "doubtful"),
        (surface(coverage_mean=0.49), "not usable"),
        (surface(depth_error=0.05), "good"),
        (surface(depth_error=0.06), "doubtful"),
        (surface(depth_error=0.16), "not usable"),
        ({}, "good"),
    ],
)
def test_the_surface(figures: dict[str, float], word: str) -> None:
    assert verdict(run_of([0] * 50, surface=figures)).word == word


def test_few_frames_or_no_surface_are_not_usable() -> None:
    assert verdict(run_of([0] * 9)).word == "not usable"
    assert verdict(run_of([0] * 10)).word == "good"
    found = verdict(run_of([0] * 50, mesh=trimesh.Trimesh()))
    assert found.word == "not usable"
    assert found.sentence == "50 of 50 frames in one map; scale unknown; no surface"


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"camera": {"source": "assumed: horizontal field of view 70 deg"}}, "lens is a guess"),
        ({"notes": ["the scene is not rigid or the focal length is wrong: 0.98 px"]}, "one rigid shape"),
        ({"notes": ["the camera is at rest while the tissue moves: errors"]}, "hardly moves"),
        ({"notes": ["focal length: the lens has radial distortion, about 12% at half"]}, "bends straight lines"),
        ({"warnings": ["the pictures are interlaced: their even and odd rows"]}, "is interlaced"),
        ({"interrupted_at_frame": 30}, "was stopped at frame 30"),
    ],
)
def test_what_makes_a_whole_run_doubtful(facts: dict[str, Any], words: str) -> None:
    found = verdict(run_of([0] * 50, **facts))
    assert found.word == "doubtful"
    assert found.reasons[0].level == "doubtful"
    assert words in found.reasons[0].text


def test_lost_frames_and_other_maps_are_told_apart() -> None:
    texts = " ".join(reason.text for reason in verdict(run_of([0] * 90 + [LOST] * 4 + [OTHER_MAP] * 6)).reasons)
    assert "6 more frames form submaps of their own" in texts
    assert "In 4 frames the camera could not be followed" in texts
    assert "Longest gap: 10 frames" in texts


def run_of_submaps(*submaps: tuple[int, int, float]) -> KeptRun:
    """A run of submaps: number of the map, its frames, and their inlier share; in the order of the frames."""
    place = [number for number, frames, _ in submaps for _ in range(frames)]
    shares = [share for _, frames, share in submaps for _ in range(frames)]
    run = run_of(place)
    rows = [row | {"inlier_share": f"{share}"} for row, share in zip(run.rows, shares, strict=True)]
    return replace(run, rows=rows, maps=run.maps * (max(place) + 1))


def test_submaps_are_in_order_of_time_and_the_worst_is_named() -> None:
    run = run_of_submaps((2, 20, 0.7), (0, 50, 0.9), (1, 30, 0.55))
    submaps = submaps_in_time(run)
    assert [(submap.name, submap.first, submap.last) for submap in submaps] == [
        ("maps/2", 0, 19),
        ("the result", 20, 69),
        ("maps/1", 70, 99),
    ]
    texts = [reason.text for reason in verdict(run).reasons]
    assert "Most doubtful of the submaps is maps/1, frames 70 to 99, with 55% inliers against 70% to 90%." in texts
    assert most_doubtful(submaps) is submaps[2]


def test_one_submap_is_not_compared() -> None:
    assert doubt_words(submaps_in_time(run_of_submaps((0, 50, 0.2)))) == ""
    assert doubt_words(submaps_in_time(run_of_submaps((0, 50, 0.2), (1, 20, float("nan"))))) == ""
    assert "doubtful" not in " ".join(reason.text for reason in verdict(run_of([0] * 50)).reasons)


def test_frames_that_were_not_used_are_no_gap() -> None:
    places = [0, NOT_USED, NOT_USED] * 40
    assert "Longest gap" not in " ".join(reason.text for reason in verdict(run_of(places)).reasons)
    places[30:45] = [LOST, NOT_USED, NOT_USED] * 5
    assert "Longest gap: 5 frames" in " ".join(reason.text for reason in verdict(run_of(places)).reasons)


def test_scale_is_known_where_it_is_measured_or_anchored() -> None:
    anchors = {"measured depth": True, "near-far 5:80 mm": True, "millimetres as scopenet gives them": False, "": False}
    assert {anchor: scale_is_known({"estimators": {"anchor": anchor}}) for anchor in anchors} == anchors
    assert "scale known" in verdict(run_of([0] * 50, estimators={"anchor": "measured depth"})).sentence


def test_the_longest_segment() -> None:
    assert longest_segment(np.array([1, 1, 0, 1, 1, 1, 0], bool)) == 3
    assert longest_segment(np.zeros(4, bool)) == 0
    assert longest_segment(np.zeros(0, bool)) == 0


def test_the_document_states_the_thresholds() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    shares = (rules.GOOD_SHARE, rules.LEAST_SHARE, rules.GOOD_COVERAGE, rules.LEAST_COVERAGE)
    for share in (*shares, rules.GOOD_DISAGREEMENT, rules.MOST_DISAGREEMENT):
        assert f"{share:.0%}".replace("%", " %") in text
    assert f"fewer than {rules.LEAST_FRAMES} frames" in text


@pytest.mark.parametrize(
    ("notes", "expected"),
    [
        ([], "there the surface is a mean. Tissue that moves as a whole looks like a moving camera."),
        (
            ["fusion: as seen at second 3 where tissue moves on its own"],
            "there the surface is as seen at one moment. Tis",
        ),
        (["tracking: the camera is at rest, as stated: all motion is the tissue's"], "there the surface is a mean."),
    ],
)
def test_moving_tissue_is_said_and_does_not_change_the_word(notes: list[str], expected: str) -> None:
    moving = "tissue: in 41 of 62 frames more than 10% of the picture moves on its own; most in frame 47: 94%"
    found = verdict(run_of([0] * 62, notes=[moving, *notes]))
    said = [reason for reason in found.reasons if "moves on its own in 41 of 62 frames" in reason.text]
    assert [reason.level for reason in said] == ["note"]
    assert expected in said[0].text
    assert found.word == "good"
    assert ("looks like a moving camera" in said[0].text) == (not any("as stated" in note for note in notes))


def test_a_camera_stated_to_be_at_rest_is_no_doubt() -> None:
    of_the_data = "the camera is at rest while the tissue moves: errors of the path say little here"
    stated = "tracking: the camera is at rest, as stated: all motion is the tissue's"
    assert verdict(run_of([0] * 62, notes=[of_the_data])).word == "doubtful"
    found = verdict(run_of([0] * 62, notes=[of_the_data, stated]))
    assert found.word == "good"
    assert any("stated to be at rest" in reason.text for reason in found.reasons)
