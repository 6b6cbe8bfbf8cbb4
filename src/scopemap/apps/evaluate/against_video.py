"""Measures a run's surface against its own video: frames kept out of fusion are compared with the mesh of the others.

The run's frames are fused again with its settings, poses and depth, but for every n-th one; masks are made again.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.depth.perceptual import CHECKPOINTS, PACKAGES, create_perceptual
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import FrameAgreement, agreement_figures, compare_rendering, lit_like
from scopemap.engine.fusion.finish import finished
from scopemap.engine.fusion.frame_selection import FrameSelector
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.free_space import FreeSpace, reference_frames
from scopemap.engine.fusion.surface_fusion import SurfaceFusion
from scopemap.engine.geometry.rendering import Rendering, render_mesh, render_points
from scopemap.engine.geometry.se3 import transform
from scopemap.engine.models import weights
from scopemap.engine.models.device import missing_packages
from scopemap.report.depth_figures import draw_renderings
from scopemap.result.evidence import notices_of
from scopemap.result.result import Result
from scopemap.runner.reread_frames import open_input

_HELD_OUT_EVERY = 10
_WORST = 3  # frames that are drawn


@dataclass(frozen=True)
class SurfaceAgreement:
    """Agreement with the frames kept out of fusion and with those fused, by number; the worst of the former, drawn.

    nearest : of the former with the coloured points of the nearest fused frame, seen from there: about the most that a
        surface of this depth can reach. lpips_missing : why LPIPS was not measured; "": it was.
    """

    held_out: dict[int, FrameAgreement] = field(default_factory=dict)
    fused: dict[int, FrameAgreement] = field(default_factory=dict)
    nearest: dict[int, FrameAgreement] = field(default_factory=dict)
    worst: list[tuple[Frame, Rendering]] = field(default_factory=list)
    lpips_missing: str = ""

    def figures(self) -> dict[str, Any]:
        """Return the figures of `agreement_figures` for each kind of frames, and what is to be said about them.

        worst_frames : numbers of the drawn frames, as text. lpips : why it was left out; absent where it was measured.
        """
        kinds = {"held_out": self.held_out, "fused": self.fused, "nearest_frame": self.nearest}
        figures: dict[str, Any] = {name: agreement_figures(kind.values()) for name, kind in kinds.items()}
        figures["worst_frames"] = ", ".join(str(frame.index) for frame, _ in self.worst)
        return figures | ({"lpips": self.lpips_missing} if self.lpips_missing else {})

    def save(self, folder: Path) -> None:
        """Write FOLDER/frames.csv, one row per frame, and FOLDER/worst.png: frame, rendering, difference."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            kinds = ((self.held_out, False), (self.fused, True))
            rows = [
                {"index": index, **agreement._asdict(), "fused": int(fused)}
                for kind, fused in kinds
                for index, agreement in kind.items()
            ]
            columns = [name for name in rows[0] if name != "lpips" or not self.lpips_missing]
            with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, columns, extrasaction="ignore")
                writer.writeheader()
                writer.writerows(sorted(rows, key=lambda row: row["index"]))
            draw_renderings({frame.index: (frame.rgb, view.rgb) for frame, view in self.worst}, folder / "worst.png")
        except OSError as error:
            raise InputError(f"cannot write to {folder}: {error.strerror or error}") from None


class RunFrames:
    """The frames of a run's surface, read again from its folder and its input, in an unnamed file there until `close`.

    Raises `InputError` where the run has no surface, kept no depth, or its input is not there any more.
    """

    def __init__(self, run: Path, source: Path | None = None) -> None:
        folder = Result(run)
        fusion = folder.config.fusion
        if fusion.voxel_mm is None or not fusion.enabled:
            raise InputError(f"the run {run} has no surface that could be compared with its video")
        (sequence, mask), depth = open_input(run, source), folder.depth
        if not depth.present:
            raise InputError(f"the run {run} kept no depth maps")
        self._run, self._store = run, FrameStore(run)
        # Of those that are read here.
        self._fusion = fusion.model_copy(update={"every": fusion.every and 1})
        self._segment_of = folder.segment_at
        self.indices: list[int] = []
        """Numbers of the frames: the tracked ones that are fused."""
        tracked = folder.frames.rows[folder.frames.tracked][:: fusion.every or 1]
        pose_of = dict(zip(tracked["index"].tolist(), tracked["T_world_camera"], strict=True))
        by_network = folder.config.mask.instruments == "auto"
        for frame in map(mask, sequence.frames()):
            if frame.index in pose_of and (depth_mm := depth.read(frame.index)) is not None:
                sigma_mm, pose = depth.read_sigma(frame.index), pose_of[frame.index]
                instruments = np.isnan(depth_mm) if by_network else None  # depth is unknown there
                frame = replace(frame, depth_mm=depth_mm, depth_sigma_mm=sigma_mm, instruments=instruments)
                self._store.put(replace(frame, T_world_camera=pose))
                self.indices.append(frame.index)
        left_out = any(notice.code == "fusion-free-space" for notice in notices_of(folder.provenance))
        references = reference_frames(self.indices) if left_out else []
        self._free_space = FreeSpace(self._store.frames(references))

    def close(self) -> None:
        """Delete the unnamed file."""
        self._store.close()

    def fuse(self, without: Collection[int] = ()) -> dict[int, trimesh.Trimesh]:
        """Return the surface of each segment, by its number, of all its frames but those with the given numbers."""
        fused = sorted(set(self.indices) - set(without), key=self._segment_of)
        return {segment: self._fused({*own}) for segment, own in groupby(fused, self._segment_of)}

    def _fused(self, fused: Collection[int]) -> trimesh.Trimesh:
        """Return the surface of the frames with these numbers."""
        fusion = SurfaceFusion(self._fusion, self._store, corrected=True)
        frames = FrameSelector(self._fusion.every).among(self.frames(fused))
        surface = fusion.fuse(frames, self._store.median_depth_mm(fused))
        return finished(surface.mesh, surface.settings)

    def frames(self, among: Collection[int] | None = None) -> Iterator[Frame]:
        """Yield all frames or some, without what others look through."""
        return map(self._free_space.without, self._store.frames(among))

    def agreement(self) -> SurfaceAgreement:
        """Return the agreement of the surface with the video; every tenth frame is kept out of fusion.

        Raises `InputError` where the frames are too few for that.
        """
        held_out = frozenset(self.indices[_HELD_OUT_EVERY // 2 :: _HELD_OUT_EVERY])
        if not held_out:
            which = f"every {_HELD_OUT_EVERY}th"
            raise InputError(f"the run {self._run} has too few tracked frames to keep {which} out of fusion")
        surfaces, missing = self.fuse(without=held_out), _lpips_missing()
        perceptual = None if missing else create_perceptual("lpips")
        found = SurfaceAgreement(lpips_missing=missing)
        views: list[tuple[float, Frame, Rendering]] = []
        for frame in self.frames():
            mesh = surfaces.get(self._segment_of(frame.index), trimesh.Trimesh())
            view, depth_mm = render_mesh(mesh, frame.camera, _pose(frame)), _usable_depth(frame)
            if self._fusion.without_light:
                view = lit_like(view, frame.camera, frame.rgb, depth_mm)
            agreement = compare_rendering(view, frame.rgb, depth_mm, perceptual)
            if frame.index not in held_out:
                found.fused[frame.index] = agreement
                continue
            found.held_out[frame.index] = agreement
            points = self._nearest_points(frame, held_out)
            found.nearest[frame.index] = compare_rendering(points, frame.rgb, depth_mm, perceptual)
            views = sorted([*views, (agreement.coverage, frame, view)], key=lambda seen: seen[0])[:_WORST]
        found.worst.extend((frame, view) for _, frame, view in views)
        return found

    def _nearest_points(self, frame: Frame, held_out: Collection[int]) -> Rendering:
        """Return the points of the nearest frame that is fused, seen from a frame."""
        fused = (index for index in self.indices if index not in held_out)
        nearest = min(fused, key=lambda index: abs(index - frame.index), default=frame.index)
        other = next(self.frames([nearest]))
        depth_mm = _usable_depth(other)
        known = depth_mm > 0
        points_mm = transform(_pose(other), (other.camera.rays * depth_mm[..., None])[known])
        return render_points(points_mm, other.rgb[known], frame.camera, _pose(frame))


def held_out_agreement(run: Path, source: Path | None = None) -> SurfaceAgreement:
    """Return the agreement of a run's surface with its video; every tenth tracked frame is kept out of fusion.

    source : where its input is now; else it is looked for. LPIPS is measured where its weights are present. Raises
    `InputError` where the run has no surface, kept no depth,
    its input is not there any more, or too few of its frames are tracked.
    """
    with closing(RunFrames(run, source)) as frames:
        return frames.agreement()


def _lpips_missing() -> str:
    """Return why LPIPS cannot be measured here, or ""."""
    if fault := missing_packages("LPIPS", *PACKAGES):
        return f"left out: {fault}"
    if weights.is_present(*CHECKPOINTS):
        return ""
    return f"left out: needs the weights {' or '.join(CHECKPOINTS)} in {weights.weights_folder()}"


def _pose(frame: Frame) -> np.ndarray:
    assert frame.T_world_camera is not None
    return frame.T_world_camera


def _usable_depth(frame: Frame) -> np.ndarray:
    assert frame.depth_mm is not None
    return np.where(frame.valid, frame.depth_mm, np.nan)
