"""Measures a run's surface against its own video: frames kept out of fusion are compared with the mesh of the others.

The run's frames are fused again with its settings, poses and depth, but for every n-th one. What the run does not keep
is made again (masks) or left out (the standard deviation of depth, so that all pixels of a frame weigh alike).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from scopemap.benchmark.result import read_provenance
from scopemap.benchmark.truth import is_camera_of, open_truth
from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.frame import Frame
from scopemap.fusion.agreement import FrameAgreement, agreement_figures, compare_with_frame
from scopemap.fusion.volume import TsdfVolume
from scopemap.geometry.rendering import Rendering
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker
from scopemap.reconstruction import DepthReader
from scopemap.report.depth_figures import draw_renderings
from scopemap.trajectory.formats.opening import read_trajectory

HELD_OUT_EVERY = 10
_WORST = 3  # frames that are drawn


@dataclass(frozen=True)
class SurfaceAgreement:
    """Agreement with the frames kept out of fusion and with those fused, by number; the worst of the former, drawn."""

    held_out: dict[int, FrameAgreement]
    fused: dict[int, FrameAgreement]
    worst: list[tuple[Frame, Rendering]]

    def figures(self) -> dict[str, dict[str, float]]:
        """Return the figures of `agreement_figures` for both kinds of frames."""
        return {
            "held_out": agreement_figures(self.held_out.values()),
            "fused": agreement_figures(self.fused.values()),
        }

    def save(self, folder: Path) -> None:
        """Write FOLDER/frames.csv, one row per frame, and FOLDER/worst.png: frame, rendering, difference."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            kinds = ((self.held_out, False), (self.fused, True))
            rows = [
                {"index": index, **asdict(agreement), "fused": int(fused)}
                for kind, fused in kinds
                for index, agreement in kind.items()
            ]
            with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, rows[0])
                writer.writeheader()
                writer.writerows(sorted(rows, key=lambda row: row["index"]))
            draw_renderings({frame.index: (frame.rgb, view.rgb) for frame, view in self.worst}, folder / "worst.png")
        except OSError as error:
            raise InputError(f"cannot write to {folder}: {error.strerror or error}") from None


def held_out_agreement(run: Path, every: int = HELD_OUT_EVERY) -> SurfaceAgreement:
    """Return the agreement of a run's surface with its video; every `every`-th tracked frame is kept out of fusion.

    Raises `InputError` where the run has no surface, kept no depth, or its input is not there any more.
    """
    config = Config.load(file=run / "config.toml")
    if config.fusion.voxel_mm is None or not config.fusion.enabled:
        raise InputError(f"the run {run} has no surface that could be compared with its video")
    volume = TsdfVolume(config.fusion)
    for number, frame in enumerate(_frames(run, config)):
        if number % every != every // 2:
            volume.integrate(frame)
    mesh = volume.extract_mesh()
    held_out, fused = dict[int, FrameAgreement](), dict[int, FrameAgreement]()
    views: list[tuple[float, Frame, Rendering]] = []
    for number, frame in enumerate(_frames(run, config)):
        assert frame.depth_mm is not None and frame.T_world_camera is not None  # noqa: PT018
        depth_mm = np.where(frame.valid, frame.depth_mm, np.nan)
        agreement, view = compare_with_frame(mesh, frame.camera, frame.T_world_camera, frame.rgb, depth_mm)
        if number % every != every // 2:
            fused[frame.index] = agreement
            continue
        held_out[frame.index] = agreement
        views = sorted([*views, (agreement.coverage, frame, view)], key=lambda seen: seen[0])[:_WORST]
    if not held_out:
        raise InputError(f"the run {run} has too few tracked frames to keep every {every}th out of fusion")
    return SurfaceAgreement(held_out, fused, [(frame, view) for _, frame, view in views])


def _frames(run: Path, config: Config) -> Iterator[Frame]:
    """Yield the run's tracked frames that are fused, with valid pixels, depth and pose."""
    source = Path(read_provenance(run).get("input", ""))
    if not source.exists():
        raise InputError(f"the input {source} of the run {run} is not there any more")
    depth, trajectory, sequence = DepthReader(run), read_trajectory(run), open_truth(run, source)
    if not depth.present or not is_camera_of(run, sequence):
        raise InputError(f"the run {run} kept no depth maps, or its input gives another camera now")
    tracked = np.flatnonzero(trajectory.status != "lost")
    pose_of = {int(trajectory.indices[k]): trajectory.T_world_camera[k] for k in tracked[:: config.fusion.every]}
    mask = Masker(config.mask, create_masks(config.mask, sequence.rectifier, sequence.source.masks))
    for frame in sequence.frames():
        masked = mask(frame)
        if frame.index in pose_of and (depth_mm := depth.read(frame.index)) is not None:
            yield replace(masked, depth_mm=depth_mm, T_world_camera=pose_of[frame.index])
