"""The rules by which a run is good, doubtful or not usable; docs/report.md states the same thresholds."""

from __future__ import annotations

import json
import re
from string import Formatter
from typing import Any

import pytest
import trimesh

from scopemap.engine.config import Config
from scopemap.engine.notices import KINDS, Notice
from scopemap.report.summary_picture import _head_lines
from scopemap.result.evidence import Evidence, notices_of
from scopemap.result.frame_table import LOST, NOT_USED
from scopemap.result.result import Result
from scopemap.result.submap_summaries import most_doubtful, submaps_in_time
from scopemap.result.verdict import LEAST_FRAMES, RULES, SEGMENT_RULES, Limit, Rule, gives_reason, verdict
from scopemap.result.wording import LEVEL_WORDS, WORDINGS, facts_of_notices, in_words, text_of
from tests.support.drawn_run import CAMERA, GOOD_SURFACE, changed, placed_frames, tube
from tests.support.places import ROOT

DOCUMENT = ROOT / "docs" / "report.md"


def run_of(
    place: list[int], *, mesh: trimesh.Trimesh | None = None, shares: list[float] | None = None, **facts: Any
) -> Result:
    provenance = {
        "camera": {"source": "calibration file camera.yaml", "origin": "calibrated"},
        "surface": GOOD_SURFACE,
    } | facts
    columns = {} if shares is None else {"inlier_share": shares}
    one = Result.in_memory(
        CAMERA, placed_frames(place, **columns), tube() if mesh is None else mesh, Config(), provenance
    )
    return changed(one, others=[one] * max(*place, 0))


def surface(**figures: float) -> dict[str, float]:
    return GOOD_SURFACE | figures


def moving(frames: int) -> Notice:
    place = {"most": 3, "share": 0.4, "x": 0.5, "y": 0.5}
    return Notice("tissue-moves", {"frames": frames, "measured": 60, "threshold": 0.1} | place)


def adjusted(keyframes: int, rotation_deg: float) -> Notice:
    facts = {"keyframes": keyframes, "rotation_deg": rotation_deg, "sigma_px": 0.2, "depth_change": 0.1}
    return Notice("mapping-adjusted", facts | {"loops": 0, "maps": 1})


def test_a_whole_run_is_good_and_its_sizes_are_unknown() -> None:
    found = verdict(run_of([0] * 100))
    assert found.word == "good"
    assert (
        found.sentence == "100 of 100 frames are in the result. The scale is unknown. "
        "The surface covers 94 % of what these frames show, not of the organ."
    )
    assert [reason.level for reason in found.reasons] == ["good", "good", "good"]
    assert found.advice == "The shape can be used. Sizes are unknown: compare shapes, do not measure."


def test_a_lens_that_the_motion_does_not_test_is_a_condition() -> None:
    found = verdict(run_of([0] * 100, **notices(Notice("camera-unconfirmed", {"sigma": 0.2}))))
    assert found.word == "good"
    assert found.advice.startswith("The shape can be used if the calibration is right: the motion does not test it. ")


def test_sizes_by_a_range_that_was_typed_are_not_called_known() -> None:
    scale = {"known": True, "measured": False, "stated": True, "source": "near-far 10:80 mm"}
    found = verdict(run_of([0] * 100, scale=scale))
    assert " The scale is as you stated it. " in found.sentence
    assert "Sizes rest on your near-far 10:80 mm: check a length that you know." in found.advice
    found = verdict(run_of([0] * 100, scale=scale | {"stated": False, "measured": True, "source": "measured depth"}))
    assert "Sizes are known (from measured depth)." in found.advice


def notices(*found: Notice) -> dict[str, Any]:
    return {"notices": facts_of_notices(found)}


ANOTHER_LENS = {"change": -0.08, "gain": 0.05}
MASKS = Notice("masks-missing", {"missing": 40, "frames": 50, "folder": "masks"})


def test_notices_come_first_and_once() -> None:
    counts = {"submaps": 10, "frames": 77, "tracked": 181, "saved": 2, "least": 5}
    said_elsewhere = [Notice("submaps-apart", counts), Notice("input-interrupted", {"frame": 30})]
    other = Notice("input-warning", {"text": "the video a.mp4 holds 3 damaged picture(s), which were left out"})
    assumed = Notice("input-note", {"text": "time stamps: frame number / 30 s"})
    facts = notices(*said_elsewhere, assumed, other, other, MASKS)
    found = verdict(run_of([0] * 40 + [LOST] * 10, **facts, interrupted_at_frame=30))
    assert [(reason.code, reason.level, reason.text) for reason in found.reasons[:3]] == [
        ("interrupted", "doubtful", "The run was stopped at frame 30: later frames are missing."),
        ("masks-missing", "doubtful", "40 of 50 frames have no mask in masks: instruments may be part of the surface."),
        ("input-warning", "note", "The video a.mp4 holds 3 damaged picture(s), which were left out."),
    ]
    assert any(
        reason.text.startswith("80 % of the frames until frame 30 are in the result") for reason in found.reasons
    )
    assert not {"submaps-apart", "input-interrupted", "input-note"} & {reason.code for reason in found.reasons}


@pytest.mark.parametrize(
    ("inside", "word"), [(100, "good"), (80, "good"), (79, "doubtful"), (30, "doubtful"), (29, "not usable")]
)
def test_the_share_of_frames_in_the_result(inside: int, word: str) -> None:
    assert verdict(run_of([0] * inside + [LOST] * (100 - inside))).word == word


@pytest.mark.parametrize(
    ("apart", "level", "word"), [(40, "doubtful", "good"), (40, "bad", "doubtful"), (29, "good", "doubtful")]
)
def test_submaps_of_three_seconds_that_are_usable_stand_for_their_part(apart: int, level: str, word: str) -> None:
    """At ten frames a second; 40 of 80 frames are in the result."""
    run = run_of([0] * 40 + [1] * apart + [LOST] * (40 - apart))
    other = changed(run.others[0], provenance={"verdict": {"level": level, "reasons": []}})
    found = verdict(changed(run, others=[other]))
    assert found.word == word
    assert f"40 of 80 frames are in the result, others in 1 submap (1 {LEVEL_WORDS[level]}). " in found.sentence


@pytest.mark.parametrize(
    ("figures", "word"),
    [
        (surface(coverage_mean=0.8), "good"),
        (surface(coverage_mean=0.79), "doubtful"),
        (surface(coverage_mean=0.49), "not usable"),
        (surface(depth_error=0.05), "good"),
        (surface(depth_error=0.06), "doubtful"),
        (surface(depth_error=0.16), "not usable"),
        # A median hides a main organ that has no surface.
        (surface(within_10_percent_mean=0.75, within_10_percent_least=0.2), "good"),
        (surface(within_10_percent_mean=0.6, within_10_percent_least=0.3), "doubtful"),
        (surface(within_10_percent_mean=0.24, within_10_percent_least=0.04), "not usable"),
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
    assert found.sentence == "50 of 50 frames are in the result. The scale is unknown. There is no surface."


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"camera": {"origin": "assumed"}}, "lens is assumed"),
        (notices(Notice("mapping-not-rigid", {"sigma_px": 0.98})), "no rigid scene fits the views"),
        (notices(Notice("mapping-none")), "not adjusted: no other view confirms"),
        (notices(Notice("camera-at-rest")), "is at rest while the tissue moves"),
        (notices(Notice("camera-distorted", {"share": 0.12})), "has radial distortion"),
        (notices(Notice("input-interlaced")), "is interlaced"),
        (notices(Notice("camera-contradicted", ANOTHER_LENS)), "another lens (focal length -8 %)"),
        (
            notices(Notice("mapping-depth-disagrees", {"adjusted": 0.2, "tracked": 0.1})),
            "would differ by 20 % (10 % before)",
        ),
        (notices(moving(30)), "moves on its own in 30 of 60"),
        (notices(Notice("shape-not-determined", {"error_px": 0.3, "other_px": 0.31})), "does not determine the shape"),
        (
            notices(Notice("mapping-not-determined", {"error_px": 0.3, "other_px": 0.31})),
            "rests on the depth network alone",
        ),
        (notices(Notice("depth-triangulated", {"triangulated": 3, "keyframes": 6})), "in only 3 of 6 keyframes"),
        (notices(Notice("mapping-without-observations", {"keyframes": 1})), "no other view confirms"),
        ({"interrupted_at_frame": 30}, "was stopped at frame 30"),
    ],
)
def test_what_makes_a_whole_run_doubtful(facts: dict[str, Any], words: str) -> None:
    found = verdict(run_of([0] * 50, **facts))
    assert found.word == "doubtful"
    assert found.reasons[0].level == "doubtful"
    assert words in found.reasons[0].text


def test_tissue_that_moves_in_few_frames_and_a_usual_adjustment_are_no_doubt() -> None:
    assert verdict(run_of([0] * 60, **notices(moving(29), adjusted(16, 2.9)))).word == "good"
    at_rest = Notice("camera-at-rest-stated")
    rested = verdict(run_of([0] * 60, **notices(moving(60), at_rest)))
    assert rested.word == "good"
    assert not any(reason.next_step for reason in rested.reasons if reason.code == "tissue-moves")
    confirmed = Notice("depth-triangulated", {"triangulated": 4, "keyframes": 6})
    assert verdict(run_of([0] * 60, **notices(adjusted(100, 5.9), confirmed))).word == "good"


def test_where_the_motion_determines_the_shape_triangulation_need_not() -> None:
    few = Notice("depth-triangulated", {"triangulated": 3, "keyframes": 6})
    assert verdict(run_of([0] * 60, **notices(few))).word == "doubtful"
    determined = Notice("shape-determined", {"correlation": 0.99})
    assert verdict(run_of([0] * 60, **notices(few, determined))).word == "good"
    decided = Notice("shape-decided", {"error_px": 0.2, "other_px": 0.3})
    assert verdict(run_of([0] * 60, **notices(few, decided))).word == "good"


def run_of_submaps(*submaps: tuple[int, int, float]) -> Result:
    """A run of submaps: number of the map, its frames, and their inlier share; in the order of the frames."""
    place = [number for number, frames, _ in submaps for _ in range(frames)]
    return run_of(place, shares=[share for _, frames, share in submaps for _ in range(frames)])


def test_submaps_are_in_order_of_time_and_the_worst_is_named() -> None:
    run = run_of_submaps((2, 20, 0.7), (0, 50, 0.9), (1, 30, 0.55))
    submaps = submaps_in_time(run.frames)
    assert [(submap.name, submap.first, submap.last) for submap in submaps] == [
        ("maps/2", 0, 19),
        ("the result", 20, 69),
        ("maps/1", 70, 99),
    ]
    texts = [reason.text for reason in verdict(run).reasons]
    assert "The most doubtful submap is maps/1 (frames 70 to 99), with 55 % inliers against 70 % to 90 %." in texts
    assert most_doubtful(submaps) is submaps[2]


def test_frames_that_were_not_used_are_no_gap() -> None:
    places = [0, NOT_USED, NOT_USED] * 40
    assert "longest gap" not in " ".join(reason.text for reason in verdict(run_of(places)).reasons)
    places[30:45] = [LOST, NOT_USED, NOT_USED] * 5
    assert "the longest gap is 5 frames" in " ".join(reason.text for reason in verdict(run_of(places)).reasons)


DOCUMENTED = {
    "usable_share": "frames in usable segments",
    "coverage_mean": "surface covers",
    "depth_error": "depth of the surface",
    "within_10_percent_mean": "share of the picture",
    "triangulated_share": "keyframes whose depth several views confirm",
    "moving_share": "frames in which tissue moves",
}
"""The rows of docs/report.md with a limit on a share, by the figure."""


def in_the_document(limit: Limit) -> str:
    """The words of docs/report.md for a limit on a share."""
    share = "half" if limit.value == 0.5 and limit.sign in "<>" else f"{100 * limit.value:.0f} %"
    words = {">=": "{} or more", "<=": "{} or less", ">": "more than {}", "<": "less than {}"}
    return words[limit.sign].format(share)


def test_the_document_states_the_limits_of_the_table() -> None:
    text = DOCUMENT.read_text(encoding="utf-8").split("## The verdict")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    with_limit = {rule.figure: rule for rule in RULES if rule.good and 0 < rule.good.value < 1}
    assert set(with_limit) == set(DOCUMENTED)
    for figure, beginning in DOCUMENTED.items():
        (row,) = (row for row in rows if row[0].startswith(beginning))
        rule = with_limit[figure]
        assert rule.good is not None
        assert row[1] == in_the_document(rule.good)
        if rule.doubtful:
            assert row[2] == in_the_document(rule.doubtful)
        assert bool(row[3]) == (rule.otherwise == "bad")
    assert f"fewer than {LEAST_FRAMES} frames" in text


ALL_RULES = tuple(dict.fromkeys((*RULES, *SEGMENT_RULES)))


@pytest.mark.parametrize("rule", ALL_RULES, ids=lambda rule: f"{rule.code} {rule.figure}")
def test_a_row_of_the_table_names_a_figure_and_codes_that_exist(rule: Rule) -> None:
    none_known = Evidence(0, 0, None, None, None, None, None, ())
    assert rule.level(none_known) in {None, "good", rule.otherwise}
    codes = {*KINDS, *(row.code for row in RULES)}
    assert {*rule.unless, *rule.replaces} <= codes
    assert rule.sentence or any(other.sentence for other in RULES if other.code == rule.code) or rule.code in KINDS


def test_a_camera_stated_to_be_at_rest_is_no_doubt() -> None:
    of_the_data = Notice("camera-at-rest")
    assert verdict(run_of([0] * 62, **notices(of_the_data))).word == "doubtful"
    stated = Notice("camera-at-rest-stated")
    found = verdict(run_of([0] * 62, **notices(of_the_data, stated)))
    assert found.word == "good"
    assert any(reason.code == "camera-at-rest-stated" for reason in found.reasons)


def fields_of(code: str) -> set[str]:
    """The values that the sentence of a notice names."""
    return {name for _, name, _, _ in Formatter().parse(WORDINGS[code].text) if name}


@pytest.mark.parametrize("code", KINDS)
def test_every_notice_has_words_and_survives_json(code: str) -> None:
    text, named = WORDINGS[code].text, fields_of(code)
    assert named <= set(KINDS[code].values)
    values = {name: 0.5 if re.search(rf"{{{name}:", text) else f"<{name}>" for name in KINDS[code].values}
    notice = Notice(code, values)
    shown = [value for name, value in values.items() if isinstance(value, str) and name in named]
    assert all(value.casefold() in text_of(notice).casefold() for value in shown)
    assert "{" not in in_words(notice)
    assert text_of(notice).endswith(".")
    (found,) = notices_of(json.loads(json.dumps(notices(notice, notice))))
    assert found == notice
    with pytest.raises(ValueError, match=code):
        Notice(code, values | {"more": 1})


def test_a_notice_of_another_version_is_read_by_the_values_that_are_known() -> None:
    older = {"code": "mapping-not-rigid", "values": {"sigma_px": 0.98, "merged": ""}}
    unknown = [{"code": "of-a-later-version", "values": {}}, {"code": "mapping-not-rigid", "values": {}}]
    assert notices_of({"notices": [older, *unknown]}) == [Notice("mapping-not-rigid", {"sigma_px": 0.98})]


def test_words_are_of_notices_alone() -> None:
    assert set(WORDINGS) == set(KINDS)


def test_the_documents_list_every_code_with_its_values() -> None:
    table = (DOCUMENT.parent / "formats.md").read_text(encoding="utf-8").split("### Notices")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `([a-z-]+)` \| (\w+) \|(?: `([a-z_, ]+)`)? \|", table, flags=re.MULTILINE)
    listed = {code: (level, values) for code, level, values in rows}
    assert listed == {code: (kind.level, ", ".join(sorted(kind.values))) for code, kind in KINDS.items()}


def test_no_doubtful_notice_is_left_out_of_the_verdict() -> None:
    assert [code for code, kind in KINDS.items() if kind.level == "doubtful" and not gives_reason(code)] == []


def test_the_summary_names_every_caution() -> None:
    run = run_of([0] * 60, interrupted_at_frame=30, camera={"origin": "assumed"}, surface=surface(depth_error=0.06))
    found = verdict(run)
    cautions = [reason.text for reason in found.reasons if reason.level in ("bad", "doubtful")]
    assert len(cautions) == 3
    lines = " ".join(_head_lines(found))
    assert all(caution in lines for caution in cautions)
    assert found.sentence in lines
