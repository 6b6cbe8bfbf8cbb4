"""`inspect` finds each peculiarity of a made-up video, and nothing in a clean one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.apps.inspect.clip import VideoFinding
from scopemap.apps.inspect.inspecting import Inspection, inspect
from scopemap.apps.inspect.inspection_sheet import write_mask
from scopemap.engine.errors import InputError
from scopemap.input.mask_files import MaskFiles
from scopemap.input.opening import open_sequence, open_source
from scopemap.input.scopes import SCOPES
from tests.support.drawn_bags import IMAGE, Bag
from tests.support.drawn_clips import (
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
    text,
    tissue,
    write,
)
from tests.support.drawn_dicom import write_dicom_video

pytestmark = pytest.mark.slow

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


def inspected(folder: Path, *changes: Change, count: int = COUNT) -> Inspection:
    """The inspection of a made-up video."""
    return inspect(write(folder / "video.mp4", clip(count, *changes)))


def by_code(inspection: Inspection) -> dict[str, VideoFinding]:
    return {finding.code: finding for finding in inspection.findings}


def test_nothing_is_found_in_a_clean_video(tmp_path: Path) -> None:
    found = inspected(tmp_path)
    assert found.findings == ()
    assert (found.overlays, found.insets, found.packed, found.field.shape) == ((), (), None, "full")
    assert (found.facts["codec"], found.facts["bits"], found.facts["pictures"]) == ("mpeg4", 8, COUNT)
    assert found.facts["usual_rate_hz"] == pytest.approx(25)
    assert found.forecast == "good: motion, sharpness and texture suit a reconstruction"
    every_tenth = inspect(found.path, frames=slice(None, None, 10))
    assert every_tenth.forecast.startswith("of one frame in 10: ")


@pytest.mark.parametrize(
    ("shape", "draw"),
    [("circle", circle), ("cut corners", octagon), ("rounded corners", rounded), ("bars", bars)],
)
def test_the_field_of_view_is_known_with_its_outline(
    tmp_path: Path, shape: str, draw: Callable[[np.ndarray], None]
) -> None:
    found = inspected(tmp_path, inside(draw))
    assert [code for code in by_code(found) if code != "scope"] == []
    assert found.field.shape == shape
    truth, drawn = np.zeros(SIZE[::-1], np.uint8), np.zeros(SIZE[::-1], np.uint8)
    draw(truth)
    cv2.fillPoly(drawn, [(found.field.outline * SIZE - 0.5).round().astype(int)], 1)
    assert (drawn != truth).mean() < 0.03
    assert found.field.share == pytest.approx(truth.mean(), abs=0.03)


def disc(radius_px: int) -> Callable[[np.ndarray], object]:
    """A round field around the picture's middle."""
    return lambda mask: cv2.circle(mask, (mask.shape[1] // 2, mask.shape[0] // 2), radius_px, 1, -1)


def cut(left: int, corner_px: int) -> Callable[[np.ndarray], object]:
    """A rectangle with cut corners, some pixels inside of the picture's left and right."""
    low, across = SIZE[1] - 1, SIZE[0] - 1 - 2 * left
    a, b, c = corner_px, across - corner_px, low - corner_px
    corners = [[0, a], [a, 0], [b, 0], [across, a], [across, c], [b, low], [a, low], [0, c]]
    return lambda mask: cv2.fillConvexPoly(mask, np.add(corners, [left, 0]), 1)


@pytest.mark.parametrize(
    ("draw", "size", "kinds"),
    [(circle, SIZE, "laparoscope|cystoscope|sinus|bronchoscope|ureteroscope"),
     (disc(112), (240, 240), "laparoscope|cystoscope|sinus|bronchoscope|ureteroscope|capsule"),
     (octagon, SIZE, "colonoscope|gastroscope"),
     (cut(40, 60), SIZE, ""), (cut(0, 36), SIZE, ""),  # square, as a capsule's may be; corners as small as an arc's
     (disc(168), SIZE, ""), (disc(178), SIZE, ""),  # round, but the picture shows no more than its corners
     (rounded, SIZE, ""), (bars, SIZE, "")],
)  # fmt: skip
def test_the_kind_of_endoscope_is_guessed_where_the_field_of_view_tells_it(
    tmp_path: Path, draw: Callable[[np.ndarray], object], size: tuple[int, int], kinds: str
) -> None:
    video = write(tmp_path / "video.mp4", clip(25, inside(draw), size=size))
    advice = [found.advice for found in inspect(video).findings if found.code == "scope"]
    assert advice == ([f"--scope {kinds}: name the one that it is"] if kinds else [])
    assert set(kinds.split("|")) <= {*SCOPES, ""}
    assert "scope" not in by_code(inspect(video, camera=f"300 300 {size[0] // 2} {size[1] // 2}"))


def test_a_field_that_moves_is_reported(tmp_path: Path) -> None:
    found = inspected(tmp_path, drifting, count=75)
    assert set(by_code(found)) == {"field-moves", "scope"}
    assert found.field.moved == pytest.approx(28 / SIZE[0], abs=0.02)


def test_text_over_tissue_and_beside_it(tmp_path: Path) -> None:
    alone = inspected(tmp_path, text())
    assert set(by_code(alone)) == {"overlay", "overlay-privacy"}
    (overlay,) = alone.overlays
    assert overlay.in_field
    left, top, right, bottom = np.array(overlay.box) * [*SIZE, *SIZE]
    assert 80 < left < 95 < 180 < right < 195
    assert 42 < top < 52 < 58 < bottom < 68
    both = inspected(tmp_path, inside(circle), text(at=(110, 60)), text("ID 7", (2, 20)))
    assert set(by_code(both)) == {"overlay", "overlay-privacy", "scope"}
    assert sorted(one.in_field for one in both.overlays) == [False, True]


def test_a_picture_in_the_picture_is_found_and_its_mask_is_read_by_runs(tmp_path: Path) -> None:
    found = inspected(tmp_path, inset)
    assert set(by_code(found)) == {"inset"}
    (box,) = found.insets
    assert np.array(box) * [*SIZE, *SIZE] == pytest.approx([220, 0, 320, 80], abs=3)
    assert write_mask(found, tmp_path / "masks")
    mask = MaskFiles(tmp_path / "masks", open_sequence(found.path, size=SIZE).rectifier).covered(COUNT - 1)
    assert mask is not None
    assert mask[:76, 224:].all()
    assert not mask[90:].any()
    assert not mask[:, :210].any()


def test_the_mask_of_a_clip_without_overlays_leaves_nothing_out(tmp_path: Path) -> None:
    found = inspected(tmp_path)
    assert not write_mask(found, tmp_path / "masks")
    mask = MaskFiles(tmp_path / "masks", open_sequence(found.path, size=SIZE).rectifier).covered(0)
    assert mask is None or not mask.any()


@pytest.mark.parametrize(
    ("change", "code", "segment", "advice"),
    [(blurred, "blurred", (15, 24), "the longest part without them: --frames 25:"),
     (black, "black", (0, 9), "leave them out with --frames 10:"),
     (drape, "not-tissue", (38, 49), "leave them out with --frames :38")],
)  # fmt: skip
def test_segments_of_no_use(tmp_path: Path, change: Change, code: str, segment: tuple[int, int], advice: str) -> None:
    found = by_code(inspected(tmp_path, during(*segment, change)))
    assert set(found) - {"cut"} == {code}
    (first, last), *others = found[code].segments
    assert not others
    assert (first, last) == pytest.approx(segment, abs=1)
    assert found[code].advice.endswith(advice)


def test_fields_and_two_views_are_found_and_the_camera_may_be_that_of_one(tmp_path: Path) -> None:
    assert by_code(inspected(tmp_path, combed))["interlaced"].advice.startswith("runs use one field")
    found, camera = inspected(tmp_path, beside), tmp_path / "camera.yaml"
    assert by_code(found)["stereo"].advice == "--stereo left-right"
    assert by_code(found)["scope"].message == "two views: typical of laparoscope"
    camera.write_text(
        "%YAML:1.0\n---\nimage_width: 320\nimage_height: 240\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
        "   cols: 3\n   dt: d\n   data: [300.,0.,159.5,0.,300.,119.5,0.,0.,1.]\n"
    )
    of_one = inspect(found.path, camera=camera)
    assert of_one.size == SIZE
    assert of_one.packed is not None
    assert "scope" not in by_code(of_one)


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


@pytest.mark.parametrize(("ending", "seeks"), [("mp4", True), ("mkv", False)])
def test_of_a_long_video_parts_are_read(tmp_path: Path, ending: str, seeks: bool) -> None:
    pictures = clip(25)
    count, there_and_back = 900, pictures + pictures[::-1]
    shown = [there_and_back[n % 50] if not 400 <= n < 500 else np.zeros_like(pictures[0]) for n in range(count)]
    found = inspect(write(tmp_path / f"long.{ending}", shown))
    assert (open_source(found.path).entry(300) > 0) is seeks
    starts = np.linspace(0, count - 25, 12).round().astype(int)
    if seeks:
        starts[:-1] -= starts[:-1] % 10  # key pictures
    assert found.clip["position"].tolist() == [start + n for start in starts for n in range(25)]
    assert (found.facts["pictures"], found.facts["pictures_read"]) == (count, 300)
    black = by_code(found)["black"]
    assert black.segments == (((400, 414), (470, 494)) if seeks else ((400, 422), (477, 499)))
    assert black.advice == "the longest part without them: --frames :400"
    assert found.forecast.startswith("of 300 frames in 12 parts of the video: ")
    part = inspect(found.path, frames=slice(420, 700))
    assert part.clip["position"].tolist() == list(range(420, 700))


def images(folder: Path, pictures: list[np.ndarray], number: Callable[[int], int] = int) -> Path:
    folder.mkdir()
    for place, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number(place):03d}.png"), picture[..., ::-1])
    return folder


def test_a_folder_of_images(tmp_path: Path) -> None:
    found = inspect(images(tmp_path / "in", clip(30), lambda place: place + 5 * (place > 14)))
    assert found.findings == ()
    assert found.container is None


def test_positions_count_unreadable_images_as_frames_does(tmp_path: Path) -> None:
    folder = images(tmp_path / "in", clip(40, during(25, 39, drape)))
    for number in range(3, 9):
        (folder / f"{number:03d}.png").write_bytes(b"")
    inspection = inspect(folder)
    found = by_code(inspection)
    assert set(found) == {"source", "not-tissue", "cut"}
    assert found["not-tissue"].segments == ((25, 39),)
    assert found["not-tissue"].advice.endswith("--frames :25")
    assert [view.measures.position for view in inspection.samples][-1] > 30
    messages = [finding.message for finding in inspection.findings if finding.code == "source"]
    assert (len(messages), messages[-1]) == (4, "and 3 more warnings of the reader")
    part = by_code(inspect(folder, frames=slice(10, None, 2)))["not-tissue"]
    assert part.segments == ((26, 38),)
    assert part.advice.endswith("--frames 10:26:2")


def test_time_stamps_of_bags_and_dicom_are_their_own(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    bag = Bag()
    for number, picture in enumerate(clip(30)):
        bag.image(IMAGE, number + (8 if number > 15 else 0), picture, "rgb8")
    found = inspect(bag.write_bag1(tmp_path / "hole.bag"))
    assert found.clip.stamped
    assert found.findings == ()
    pytest.importorskip("pydicom")
    video = inspect(write_dicom_video(tmp_path / "video"))
    assert video.container is not None
    assert video.container["width"] == video.size[0]


@pytest.mark.parametrize(
    ("frames", "why"), [(slice(0, 1), r"1 frame\(s\) selected of its 4, by --frames 0:1"), (slice(0, 4, 0), "step")]
)
def test_a_selection_that_no_run_takes_is_refused(frames: slice, why: str, tmp_path: Path) -> None:
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), tissue(number))
    with pytest.raises(InputError, match=why):
        inspect(tmp_path, frames=frames)


def test_what_breaks_off_is_reported_and_what_is_no_video_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "whole.avi", clip(COUNT))
    broken = tmp_path / "broken.avi"
    broken.write_bytes(file.read_bytes()[: 2 * file.stat().st_size // 3])
    assert "breaks off" in by_code(inspect(broken))["source"].message
    (tmp_path / "no.mp4").write_bytes(b"no video")
    for path in (tmp_path / "no.mp4", tmp_path / "absent.mp4"):
        with pytest.raises(InputError):
            inspect(path)


# ---- what endangers a run


def moved(picture: np.ndarray, step_px: int, blur_px: Callable[[int], int] = lambda number: 1) -> list[np.ndarray]:
    """40 views (240, 320, 3) of a picture (H, 2400, 3), each so many px beside the one before, there and back."""
    places = [abs((step_px * number + 1800) % 3600 - 1800) for number in range(40)]
    return [cv2.blur(picture[:240, x : x + 320], (blur_px(n),) * 2) for n, x in enumerate(places)]


def mottled(seed: int) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(240, 2400)).astype(np.float32), (0, 0), 2.0)
    level = 120 + 35 * noise / noise.std()
    return np.clip(np.stack([level, 0.5 * level, 0.4 * level], -1), 20, 250).astype(np.uint8)


def test_fast_motion_makes_a_poor_forecast(tmp_path: Path) -> None:
    found = inspect(images(tmp_path / "in", moved(mottled(2), 97)))
    assert found.findings == ()
    assert found.forecast.startswith("poor: ")
    assert "several submaps" in found.forecast


def test_fast_motion_is_reported_where_frames_are_passed_over(tmp_path: Path) -> None:
    coarse = cv2.resize(mottled(2)[:80, :800], (2400, 240))
    folder = images(tmp_path / "in", moved(coarse, 10))
    assert "motion-fast" not in by_code(inspect(folder))
    every_second = by_code(inspect(folder, frames=slice(None, None, 2)))
    assert every_second["motion-fast"].advice == "use every frame: --frames without a step"


def test_a_cut_is_found_where_it_is(tmp_path: Path) -> None:
    found = inspect(images(tmp_path / "in", moved(mottled(3), 3)[:17] + moved(mottled(4), 3)[17:]))
    cut = by_code(found)["cut"]
    assert cut.segments == ((17, 17),)
    assert cut.advice.endswith("--frames 18:")
    assert found.forecast.startswith("fair: 1 frames are hard to track, 1 cut;")


def test_missing_texture_makes_a_poor_forecast(tmp_path: Path) -> None:
    ramp = np.linspace(60, 200, 2400)[None, :, None] * np.array([1.0, 0.5, 0.4]) * np.ones((240, 1, 1))
    bare = inspect(images(tmp_path / "bare", moved(ramp.astype(np.uint8), 3)))
    assert bare.forecast.startswith("poor: walls without texture")


@pytest.mark.real
@pytest.mark.parametrize(
    ("path", "codes"),
    [("endoscopy/video/laparoscopy_rvim.mp4", {"scope"}),
     ("endoscopy/video/colonoscopy_nflba_03.mp4", set()),
     ("endoscopy/endonerf/pulling_soft_tissues", {"overlay", "overlay-privacy"})],
)  # fmt: skip
def test_real_videos(real_data: Path, path: str, codes: set[str]) -> None:
    """Looked at by eye: a circle that drifts by 17 px, a picture without border, a status bar at the lower edge."""
    assert {finding.code for finding in inspect(real_data / path).findings} == codes
