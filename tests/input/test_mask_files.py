"""Masks from files: which pixels they leave out, and what is wrong with a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier, working_camera
from scopemap.engine.config import Config, MaskSettings
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline
from scopemap.input.mask_files import MaskFiles, create_masks, masks_of
from scopemap.input.opening import open_sequence
from scopemap.runner.estimators import create_estimators
from scopemap.runner.provenance import estimators_provenance
from scopemap.runner.reconstruct import reconstruct
from tests.support.drawn_inputs import frames_of, picture, save, write_video

SOURCE = PinholeCamera(400.0, 400.0, 319.5, 239.5, 640, 480)
RECTIFIER = Rectifier(SOURCE, working_camera(SOURCE, (320, 240)))


def write_masks(folder: Path, values: dict[str, np.ndarray]) -> Path:
    folder.mkdir()
    for name, image in values.items():
        assert cv2.imwrite(str(folder / name), image)
    return folder


def left_half(level: int = 255) -> np.ndarray:
    mask = np.zeros((480, 640), np.uint8)
    mask[:, :320] = level
    return mask


@pytest.mark.parametrize("level", [1, 7, 255])
def test_what_is_not_zero_is_masked_at_the_working_size(level: int, tmp_path: Path) -> None:
    folder = write_masks(tmp_path / "masks", {"frame-000007.mask.png": left_half(level)})
    covered = MaskFiles(folder, RECTIFIER).covered(7)
    assert covered.shape == (240, 320)
    assert covered[:, :160].all()
    assert not covered[:, 160:].any()


def test_noise_of_a_jpeg_is_no_mask_and_colours_and_alpha_are_read(tmp_path: Path) -> None:
    coloured = np.zeros((480, 640, 4), np.uint8)
    coloured[:, :320, 2], coloured[..., 3] = 200, 255
    values = {"1.jpg": left_half(), "2.png": coloured}
    masks = MaskFiles(write_masks(tmp_path / "masks", values), RECTIFIER)
    for index in (1, 2):
        assert masks.covered(index)[:, :158].all()
        assert not masks.covered(index)[:, 162:].any()


def test_masks_that_fit_no_frame_are_told(tmp_path: Path) -> None:
    masks = MaskFiles(write_masks(tmp_path / "masks", {"900.png": left_half(), "2.png": left_half()}), RECTIFIER)
    assert masks.notices == []
    for index in (0, 1, 2):
        masks.covered(index)
    assert masks.provenance()["masks"].endswith("; 1 of 3 frames have one")
    (notice,) = masks.notices
    assert (notice.code, notice.values["missing"], notice.values["frames"]) == ("masks-missing", 2, 3)
    masks.covered(900)
    assert masks.notices == []


def test_folders_that_do_not_do_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        MaskFiles(tmp_path / "nowhere", RECTIFIER)
    with pytest.raises(InputError, match="no image with a number"):
        MaskFiles(write_masks(tmp_path / "names", {"tool.png": left_half(), "text.png": left_half()}), RECTIFIER)
    with pytest.raises(InputError, match="have the same number"):
        MaskFiles(write_masks(tmp_path / "twice", {"a1.png": left_half(), "b1.png": left_half()}), RECTIFIER)
    damaged = write_masks(tmp_path / "damaged", {"1.png": left_half()})
    (damaged / "1.png").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"cannot read the mask .*1\.png"):
        MaskFiles(damaged, RECTIFIER).covered(1)
    narrow = write_masks(tmp_path / "narrow", {"1.png": np.zeros((480, 320), np.uint8)})
    with pytest.raises(CalibrationError, match="aspect"):
        MaskFiles(narrow, RECTIFIER).covered(1)


def test_the_only_image_without_a_number_is_for_all_frames(tmp_path: Path) -> None:
    masks = MaskFiles(write_masks(tmp_path / "masks", {"mask.png": left_half()}), RECTIFIER)
    for index in (0, 7, 123456):
        covered = masks.covered(index)
        assert covered[:, :160].all()
        assert not covered[:, 160:].any()
    assert masks.provenance()["masks"].endswith("mask.png, for all frames")
    assert masks.notices == []
    assert cv2.imwrite(str(tmp_path / "masks" / "7.png"), left_half())
    numbered = MaskFiles(tmp_path / "masks", RECTIFIER)
    assert numbered.covered(7) is not None
    assert numbered.covered(0) is None


def test_the_masker_leaves_masked_pixels_out_of_that_frame_only(tmp_path: Path) -> None:
    """The field of view is learnt over the frames: an instrument that was there once must not stay."""
    masks = MaskFiles(write_masks(tmp_path / "masks", {"0.png": left_half()}), RECTIFIER)
    rgb = np.random.default_rng(0).integers(80, 120, (240, 320, 3)).astype(np.uint8)
    frame = Frame(0, 0.0, rgb, RECTIFIER.target, np.ones((240, 320), bool))
    masker, bare = Masker(MaskSettings(), masks), Masker(MaskSettings())
    assert not masker(frame).valid[:, :160].any()
    np.testing.assert_array_equal(masker(frame).valid[:, 160:], bare(frame).valid[:, 160:])
    later = replace(frame, index=1)
    np.testing.assert_array_equal(masker(later).valid, bare(later).valid)


def test_the_pipeline_uses_the_masks_that_the_settings_name(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for i in range(3):
        save(images / f"{i}.png", picture(i, (640, 480)))
    masks = write_masks(tmp_path / "masks", {f"{i}.png": left_half() for i in range(3)})
    config = Config.load(settings={"mask.files": str(masks), "depth.backend": "shading"})
    sequence = open_sequence(images)
    estimators = create_estimators(config, sequence)
    assert estimators_provenance(estimators)["masks"].startswith("3 files")
    pipeline = Pipeline(config, estimators)
    preprocessed = pipeline.match(pipeline.estimate(frames_of(sequence)[1]))
    assert not preprocessed.frame.valid[:, :160].any()
    assert preprocessed.frame.valid[:, 160:].any()
    assert create_masks(MaskSettings(), sequence.rectifier) is None


def test_the_data_sets_own_masks_are_used_unless_others_or_none_are_asked_for(tmp_path: Path) -> None:
    own, others = (write_masks(tmp_path / name, {"0.png": left_half()}) for name in ("own", "others"))

    def used(files: str) -> str:
        masks = create_masks(MaskSettings(files=files), RECTIFIER, own)
        return "" if masks is None else masks.provenance()["masks"]

    assert used("").endswith("own")
    assert used(str(others)).endswith("others")
    assert used("none") == ""


def _codes(masks: MaskFiles, frames: range) -> dict[str, Notice]:
    for index in frames:
        masks.covered(index)
    return {notice.code: notice for notice in masks.notices}


@pytest.mark.parametrize(
    ("first_mask", "first_frame", "shift"), [(1, 0, -1), (0, 1, 1), (0, 0, 0), (1, 1, 0), (1001, 1000, -1)]
)
def test_masks_numbered_from_another_number_belong_to_the_frames_in_order(
    first_mask: int, first_frame: int, shift: int, tmp_path: Path
) -> None:
    levels = {f"{first_mask + k:05d}.png": left_half() if k == 2 else 0 * left_half() for k in range(5)}
    frames = range(first_frame, first_frame + 5)
    masks = MaskFiles(write_masks(tmp_path / "masks", levels), RECTIFIER, numbers=frames)
    assert [masks.covered(index).any() for index in frames] == [False, False, True, False, False]
    assert set(_codes(masks, frames)) == ({"masks-shifted"} if shift else set())
    if shift:
        assert _codes(masks, frames)["masks-shifted"].values["shift"] == shift


def test_masks_without_a_frame_and_masks_that_may_be_late_are_told(tmp_path: Path) -> None:
    folder = write_masks(tmp_path / "masks", {f"{k}.png": left_half() for k in (0, 1, 2, 3, 70, 71)})
    unused = _codes(MaskFiles(folder, RECTIFIER, numbers=range(6)), range(6))
    assert set(unused) == {"masks-unused"}
    assert (unused["masks-unused"].values["masks"], unused["masks-unused"].values["first"]) == (2, "70.png")
    late = write_masks(tmp_path / "late", {f"{k}.png": left_half() for k in range(1, 5)})
    told = _codes(MaskFiles(late, RECTIFIER, numbers=range(7)), range(7))
    assert set(told) == {"masks-late"}
    assert (told["masks-late"].values["frame"], told["masks-late"].values["mask"]) == (0, 1)
    assert _codes(MaskFiles(late, RECTIFIER, numbers=range(7)), range(1, 7)) == {}


@pytest.mark.parametrize(
    ("name", "level", "code"),
    [("{}.png", 0, "masks-empty"), ("{}.jpg", 1, "masks-faint"), ("{}.jpg", 90, "masks-faint"),
     ("mask.png", 0, "masks-empty"), ("{}.png", 1, "masks-large"), ("{}.jpg", 255, "masks-large"),
     ("mask.png", 1, "masks-large")],
)  # fmt: skip
def test_masks_that_hide_nothing_or_everything_are_told(name: str, level: int, code: str, tmp_path: Path) -> None:
    values = {name.format(k): np.full((480, 640), level, np.uint8) for k in range(3)}
    masks = MaskFiles(write_masks(tmp_path / "masks", values), RECTIFIER, numbers=range(3))
    assert set(_codes(masks, range(3))) == ({code} if code else set())


@pytest.mark.parametrize(("rows", "large"), [(360, False), (361, True)])
def test_masks_are_large_that_hide_more_than_three_quarters(rows: int, large: bool, tmp_path: Path) -> None:
    mask = np.zeros((480, 640), np.uint8)
    mask[:rows] = 255
    masks = MaskFiles(write_masks(tmp_path / "masks", {"0.png": mask}), RECTIFIER, numbers=range(1))
    assert set(_codes(masks, range(1))) == ({"masks-large"} if large else set())


def test_masks_numbered_from_one_beside_a_video_numbered_from_zero(tmp_path: Path) -> None:
    video = write_video(tmp_path / "v.mp4", 6)
    masks = write_masks(tmp_path / "masks", {f"{k + 1}.png": left_half() for k in range(6)})
    config = Config.load(settings={"mask.files": str(masks), "depth.backend": "shading"})
    sequence = open_sequence(video)
    estimators = create_estimators(config, sequence)
    assert estimators.masks is not None
    assert all(estimators.masks.covered(index) is not None for index in range(6))
    assert {notice.code for notice in estimators.masks.notices} == {"masks-shifted"}


def test_a_run_whose_masks_hide_nearly_all_says_so(tmp_path: Path) -> None:
    """Masks that are white at tissue: only the share of usable pixels was said."""
    video = write_video(tmp_path / "v.mp4", 3)
    inverted = np.full((480, 640), 255, np.uint8)
    inverted[:80, :80] = 0
    masks = write_masks(tmp_path / "masks", {f"{k}.png": inverted for k in range(3)})
    config = Config.load(settings={"mask.files": str(masks), "depth.backend": "shading", "input.focal": "assume"})
    with pytest.raises(InputError, match=r"is usable\. The masks in .* hide 98 % of the pictures.*invert them"):
        reconstruct(open_sequence(video), config)


DECIMALS = ("0.067", "0.2", "0.967", "1.067")
"""Times of which 0.2 is 200 and 1.067 is not 67."""


def _decimal_masks(tmp_path: Path, names: tuple[str, ...]) -> Path:
    return write_masks(tmp_path / "masks", {f"mask_{name}.png": left_half(10 * n + 9) for n, name in enumerate(names)})


def test_masks_with_decimal_numbers_belong_to_the_pictures_with_these(tmp_path: Path) -> None:
    pictures = dict(enumerate(tmp_path / f"frame_{name}.png" for name in DECIMALS))
    folder = _decimal_masks(tmp_path, DECIMALS[1:])
    masks = MaskFiles(folder, RECTIFIER, numbers=range(4), pictures=pictures)
    covered = [masks.covered(number) is not None for number in range(4)]
    assert covered == [False, True, True, True]
    assert masks.notices == []


def test_masks_with_decimal_numbers_that_no_frame_has_are_refused(tmp_path: Path) -> None:
    folder = _decimal_masks(tmp_path, DECIMALS)
    pictures = dict(enumerate(tmp_path / f"frame_{name}.png" for name in ("0.067", "0.2", "0.968", "1.067")))
    with pytest.raises(InputError, match=r"1 of 4 files, such as mask_0\.967\.png, have no frame of this number"):
        MaskFiles(folder, RECTIFIER, numbers=range(4), pictures=pictures)
    with pytest.raises(InputError, match=r"mask_0\.067\.png hold decimal numbers, and those of the frames do not"):
        MaskFiles(folder, RECTIFIER, numbers=range(4))


def test_masks_of_a_folder_of_decimal_names_are_used_for_their_own_frames(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for place, name in enumerate(DECIMALS):
        save(tmp_path / f"frames/frame_{name}.png", picture(place, (640, 480)))
    folder = _decimal_masks(tmp_path, DECIMALS)
    masks = masks_of(MaskSettings(files=str(folder)), open_sequence(tmp_path / "frames"))
    assert masks is not None
    assert all(masks.covered(number) is not None for number in range(4))
    assert masks.notices == []
