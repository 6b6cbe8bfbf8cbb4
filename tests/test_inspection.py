"""`inspect` finds each peculiarity of a made-up video, and nothing in a clean one."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_bags import IMAGE, Bag
from drawn_clips import (
    SIZE,
    Change,
    bars,
    black,
    blurred,
    circle,
    clip,
    drape,
    during,
    inset,
    inside,
    octagon,
    rounded,
    stamps_with_a_hole,
    text,
    tissue,
    write,
)
from drawn_dicom import write_dicom_video
from hypothesis import given
from hypothesis import strategies as st

from scopemap.errors import InputError
from scopemap.inspection.clip import VideoFinding, covered, segments_of
from scopemap.inspection.inspecting import Inspection, inspect
from scopemap.inspection.picture import write_mask
from scopemap.io.opening import open_sequence
from scopemap.masking.mask_files import MaskFiles

COUNT = 50


def drifting(number: int, picture: np.ndarray) -> np.ndarray:
    """The camera's head is turned: the circle lies elsewhere from frame 25 on, and again from frame 50."""
    return inside(lambda mask: cv2.circle(mask, (140 + 14 * (number // 25), 120), 95, 1, -1))(number, picture)


def combed(number: int, picture: np.ndarray) -> np.ndarray:
    """Odd rows were taken later, when the camera had moved by 5 px."""
    wide = tissue(number, (SIZE[0] + 5, SIZE[1]))
    out = wide[:, 5:].copy()
    out[1::2] = wide[1::2, :-5]
    return out


def beside(number: int, _: np.ndarray) -> np.ndarray:
    """Two views of one scene beside each other, 8 px apart."""
    wide = tissue(number, (SIZE[0] + 8, SIZE[1]))
    return np.hstack([wide[:, 8:], wide[:, :-8]])


CHANGES: dict[str, tuple[Change, ...]] = {
    "clean": (),
    "circle": (inside(circle),),
    "octagon": (inside(octagon),),
    "rounded": (inside(rounded),),
    "bars": (inside(bars),),
    "drifting": (drifting,),
    "text": (text(),),
    "text in circle": (inside(circle), text(at=(110, 60)), text("ID 7", (2, 20))),
    "inset": (inset,),
    "blur": (during(15, 24, blurred),),
    "black": (during(0, 9, black),),
    "drape": (during(38, 49, drape),),
    "interlaced": (combed,),
    "stereo": (beside,),
}
Inspect = Callable[[str], Inspection]


@pytest.fixture(scope="module")
def inspected(tmp_path_factory: pytest.TempPathFactory) -> Inspect:
    """The inspection of a made-up video, each once."""
    known: dict[str, Inspection] = {}
    folder = tmp_path_factory.mktemp("clips")

    def one(name: str) -> Inspection:
        if name not in known:
            count = 75 if name == "drifting" else COUNT
            known[name] = inspect(write(folder / f"{name}.mp4", clip(count, *CHANGES[name])))
        return known[name]

    return one


def by_code(inspection: Inspection) -> dict[str, VideoFinding]:
    return {finding.code: finding for finding in inspection.findings}


def test_nothing_is_found_in_a_clean_video(inspected: Inspect) -> None:
    found = inspected("clean")
    assert found.findings == ()
    assert (found.overlays, found.insets, found.packed, found.field.shape) == ((), (), None, "full")
    assert (found.facts["codec"], found.facts["bits"], found.facts["pictures"]) == ("mpeg4", 8, COUNT)
    assert found.facts["usual_rate_hz"] == pytest.approx(25)


@pytest.mark.parametrize(
    ("name", "shape", "draw"),
    [("circle", "circle", circle), ("octagon", "cut corners", octagon), ("rounded", "rounded corners", rounded),
     ("bars", "bars", bars)],
)  # fmt: skip
def test_the_field_of_view_is_told_with_its_outline(
    inspected: Inspect, name: str, shape: str, draw: Callable[[np.ndarray], None]
) -> None:
    found = inspected(name)
    assert list(by_code(found)) == [f"field-{shape.replace(' ', '-')}"]
    assert (found.field.shape, found.findings[0].severity) == (shape, "info")
    truth, drawn = np.zeros(SIZE[::-1], np.uint8), np.zeros(SIZE[::-1], np.uint8)
    draw(truth)
    cv2.fillPoly(drawn, [(found.field.outline * SIZE - 0.5).round().astype(int)], 1)
    assert (drawn != truth).mean() < 0.03
    assert found.field.share == pytest.approx(truth.mean(), abs=0.03)


def test_a_field_that_moves_is_told(inspected: Inspect) -> None:
    found = by_code(inspected("drifting"))
    assert set(found) == {"field-circle", "field-moves"}
    assert inspected("drifting").field.moved == pytest.approx(28 / SIZE[0], abs=0.02)


def test_text_over_tissue_and_beside_it(inspected: Inspect) -> None:
    alone = inspected("text")
    assert set(by_code(alone)) == {"overlay", "overlay-privacy"}
    (overlay,) = alone.overlays
    assert overlay.in_field
    left, top, right, bottom = np.array(overlay.box) * [*SIZE, *SIZE]
    assert 80 < left < 95 < 180 < right < 195
    assert 42 < top < 52 < 58 < bottom < 68
    both = inspected("text in circle")
    assert set(by_code(both)) == {"field-circle", "overlay", "overlay-outside", "overlay-privacy"}
    assert sorted(one.in_field for one in both.overlays) == [False, True]
    assert "--set mask.files=" in by_code(both)["overlay"].advice


def test_a_picture_in_the_picture_is_found_and_its_masks_are_read_by_runs(inspected: Inspect, tmp_path: Path) -> None:
    found = inspected("inset")
    assert set(by_code(found)) == {"inset"}
    (box,) = found.insets
    assert np.array(box) * [*SIZE, *SIZE] == pytest.approx([220, 0, 320, 80], abs=3)
    assert write_mask(found, tmp_path / "masks")
    mask = MaskFiles(tmp_path / "masks", open_sequence(found.path, size=SIZE).rectifier).covered(COUNT - 1)
    assert mask is not None
    assert mask[:76, 224:].all()
    assert not mask[90:].any()
    assert not mask[:, :210].any()
    assert not write_mask(inspected("clean"), tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("name", "code", "segment", "advice"),
    [("blur", "blurred", (15, 24), "the longest part without them: --frames 25:"),
     ("black", "black", (0, 9), "leave them out with --frames 10:"),
     ("drape", "not-tissue", (38, 49), "leave them out with --frames :38")],
)  # fmt: skip
def test_segments_of_no_use(inspected: Inspect, name: str, code: str, segment: tuple[int, int], advice: str) -> None:
    found = by_code(inspected(name))
    assert set(found) - {"cut"} == {code}
    (first, last), *others = found[code].segments
    assert not others
    assert (first, last) == pytest.approx(segment, abs=1)
    assert found[code].advice.endswith(advice)


def test_interlaced_and_stereo_pictures_name_their_option(inspected: Inspect) -> None:
    assert by_code(inspected("interlaced"))["interlaced"].advice == "--deinterlace"
    stereo = inspected("stereo")
    assert by_code(stereo)["stereo"].advice == "--stereo left-right"
    assert stereo.packed is not None


def test_freezes_and_duplicates(tmp_path: Path) -> None:
    pictures = clip(COUNT)
    found = inspect(write(tmp_path / "freeze.mp4", pictures[:30] + [pictures[29]] * 12 + pictures[30:40]))
    assert set(by_code(found)) == {"frozen"}
    (segment,) = by_code(found)["frozen"].segments
    assert segment == pytest.approx((30, 41), abs=1)
    # From 25 to 30 pictures per second: every fifth twice.
    twice = [p for i, p in enumerate(pictures) for p in ([p, p] if i % 5 == 4 else [p])]
    duplicates = by_code(inspect(write(tmp_path / "twice.mp4", twice)))["duplicates"]
    assert duplicates.segments == tuple((5 + 6 * i, 5 + 6 * i) for i in range(10))
    assert "every 6th" in duplicates.message


def test_holes_and_an_uneven_rate_of_time_stamps(tmp_path: Path) -> None:
    pictures = clip(COUNT)
    found = by_code(inspect(write(tmp_path / "hole.mp4", pictures, stamps_with_a_hole(COUNT))))
    assert set(found) == {"frames-dropped"}
    assert found["frames-dropped"].segments == ((COUNT // 2 - 1, COUNT // 2),)
    assert "about 5 picture(s)" in found["frames-dropped"].message
    uneven = [number * 3 + (number % 3 == 1) for number in range(COUNT)]
    assert set(by_code(inspect(write(tmp_path / "uneven.mp4", pictures, uneven)))) == {"rate-variable"}


def test_a_folder_of_images(tmp_path: Path) -> None:
    for number, picture in enumerate(clip(30)):
        cv2.imwrite(str(tmp_path / f"{number + 5 * (number > 14):03d}.png"), picture[..., ::-1])
    found = inspect(tmp_path)
    assert set(by_code(found)) == {"frames-dropped"}
    assert "numbers in the names" in found.findings[0].message
    assert found.container is None


def test_positions_count_unreadable_images_as_frames_does(tmp_path: Path) -> None:
    for number, picture in enumerate(clip(40, during(25, 39, drape))):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), picture[..., ::-1])
    for number in range(3, 9):
        (tmp_path / f"{number:03d}.png").write_bytes(b"")
    inspection = inspect(tmp_path)
    found = by_code(inspection)
    assert set(found) == {"source", "not-tissue", "cut"}
    assert found["not-tissue"].segments == ((25, 39),)
    assert found["not-tissue"].advice.endswith("--frames :25")
    assert [view.measures.position for view in inspection.samples][-1] > 30
    told = [finding.message for finding in inspection.findings if finding.code == "source"]
    assert (len(told), told[-1]) == (4, "and 3 more warnings of the reader")
    part = by_code(inspect(tmp_path, frames=slice(10, None, 2)))["not-tissue"]
    assert part.segments == ((26, 38),)
    assert part.advice.endswith("--frames 10:26:2")


def test_time_stamps_of_bags_and_dicom_are_their_own(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    bag = Bag()
    for number, picture in enumerate(clip(30)):
        bag.image(IMAGE, number + (8 if number > 15 else 0), picture, "rgb8")
    found = inspect(bag.write_bag1(tmp_path / "hole.bag"))
    assert "time stamps leave 1 hole(s), about 8" in by_code(found)["frames-dropped"].message
    assert found.container is None
    pytest.importorskip("pydicom")
    video = inspect(write_dicom_video(tmp_path / "video"))
    assert video.container is not None
    assert video.container["width"] == video.size[0]


def test_the_camera_may_be_that_of_one_of_two_views(tmp_path: Path) -> None:
    video, camera = write(tmp_path / "both.mp4", clip(12, beside)), tmp_path / "camera.yaml"
    camera.write_text(
        "%YAML:1.0\n---\nimage_width: 320\nimage_height: 240\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
        "   cols: 3\n   dt: d\n   data: [300.,0.,159.5,0.,300.,119.5,0.,0.,1.]\n"
    )
    found = inspect(video, camera=camera)
    assert found.size == SIZE
    assert open_sequence(video, camera=camera).source.width == SIZE[0]
    assert found.packed is not None


def test_what_breaks_off_is_said_and_what_is_no_video_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "whole.avi", clip(COUNT))
    broken = tmp_path / "broken.avi"
    broken.write_bytes(file.read_bytes()[: 2 * file.stat().st_size // 3])
    found = by_code(inspect(broken))
    assert "breaks off" in found["source"].message
    (tmp_path / "no.mp4").write_bytes(b"no video")
    for path in (tmp_path / "no.mp4", tmp_path / "absent.mp4"):
        with pytest.raises(InputError):
            inspect(path)


@pytest.mark.parametrize("name", ["circle", "blur", "black", "drape", "interlaced"])
def test_an_overlay_changes_no_other_finding(inspected: Inspect, tmp_path: Path, name: str) -> None:
    at = np.random.default_rng(len(name)).integers((70, 100), (110, 180))
    written = clip(COUNT, *CHANGES[name], text("DR. X 09:15", tuple(at.tolist())))
    codes = {f.code: f.segments for f in inspect(write(tmp_path / "text.mp4", written)).findings}
    without = {f.code: f.segments for f in inspected(name).findings if f.code != "cut"}
    others = {code: where for code, where in codes.items() if not code.startswith(("overlay", "cut"))}
    assert others == without
    assert "overlay" in codes


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 5), st.integers(0, 4))
def test_segments_cover_what_they_are_of(flags: list[bool], least: int, gap: int) -> None:
    true = np.array(flags, bool)
    segments = segments_of(true, least, gap)
    assert all(true[first] and true[last] and last - first + 1 >= least for first, last in segments)
    assert all(b[0] - a[1] > gap + 1 for a, b in pairwise(segments))
    if least == 1:
        assert not (true & ~covered(segments, len(true))).any()
        if gap == 0:
            np.testing.assert_array_equal(covered(segments, len(true)), true)


@pytest.mark.real
@pytest.mark.parametrize(
    ("path", "codes"),
    [("endoscopy/video/laparoscopy_rvim.mp4", {"field-circle", "field-moves"}),
     ("endoscopy/video/colonoscopy_nflba_03.mp4", {"motion-fast", "soft", "unlike"}),
     ("endoscopy/endonerf/pulling_soft_tissues", {"overlay", "overlay-privacy"})],
)  # fmt: skip
def test_real_videos(real_data: Path, path: str, codes: set[str]) -> None:
    """Looked at by eye: a circle that drifts by 17 px, a picture without border, a status bar at the lower edge."""
    assert {finding.code for finding in inspect(real_data / path).findings} == codes
