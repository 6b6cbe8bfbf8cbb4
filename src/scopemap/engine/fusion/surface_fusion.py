"""Fuses posed frames with depth in a TSDF volume, at once or after the last one, and returns the surface as a mesh."""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import trimesh

from scopemap.engine.config import FusionSettings
from scopemap.engine.depth.under_highlights import small_highlights
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.albedo import AlbedoPainter
from scopemap.engine.fusion.frame_selection import FrameSelector
from scopemap.engine.fusion.frame_store import FrameStore, median_depth_of
from scopemap.engine.fusion.mesh import extract_mesh
from scopemap.engine.fusion.tsdf import (
    BLOCK,
    KEY_OFFSET,
    Grid,
    TsdfCamera,
    integrate_blocks,
    measure_surface,
    touched_blocks,
    unpack,
)
from scopemap.engine.fusion.voxel_blocks import VoxelBlocks
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.geometry.uncertainty import depth_trust
from scopemap.engine.notices import Notice

# Below this cosine a slanted wall cannot be distinguished from a depth edge, with weights or without.
_MIN_COSINE = 0.05  # by hand
_MIN_INCIDENCE = 0.1  # by hand: cosine of incidence below which a pixel is not fused
_TRUNCATION_SHARE = 0.08  # by hand: truncation over the pixel's depth, where that is larger than that in mm
_DEPTH_SIGMA = 0.2  # by hand: relative error that all depth has; more uncertain pixels weigh less
# Voxels of 1 mm suit tissue 60 mm away (Endo-Depth-and-Motion, RA-L 2021, truncation 5 mm); TSDF parameters that are
# not set keep the proportions at other depths.
_VOXELS_PER_MEDIAN_DEPTH = 60
_VOXELS_PER_TRUNCATION = 5  # see above
# Finer ones show nothing more, and fill memory with the square of their number: 10 um where a pixel is 0.5 mm would
# take a terabyte a frame.
_MOST_VOXELS_PER_PIXEL = 4
# At this depth a voxel is still larger than a pixel, and a narrowing tube is seen for most of its length.
_VOXELS_PER_MAX_DEPTH = 200  # by hand
# Weight of a small highlight's colour, the one around it: it counts where no frame saw the tissue. Width of what is
# around over the picture's, and the step of the pixels looked at.
_MASKED_COLOUR = 0.01  # by hand
_SURROUNDINGS = 1 / 12  # by hand
_EVERY_PX = 4  # by hand, for time
# No endoscope resolves less; memory would be spent on noise.
_MIN_VOXEL_MM = 0.01  # by hand


class TsdfParameters(NamedTuple):
    """Edge of a voxel, truncation of the distance, and largest depth that is fused, mm."""

    voxel_mm: float
    truncation_mm: float
    max_depth_mm: float

    @property
    def notice(self) -> Notice:
        """That the parameters follow the scene, and how to set others."""
        values = {"voxel_mm": self.voxel_mm, "max_depth_mm": self.max_depth_mm}
        return Notice("fusion-scaled", values | {"divisor": _VOXELS_PER_MEDIAN_DEPTH})


def choose_parameters(settings: FusionSettings, median_depth_mm: float | None = None) -> TsdfParameters:
    """Return the parameters, those not set by `median_depth_mm`; `ValueError` if neither it nor `voxel_mm` is known."""
    voxel_mm = settings.voxel_mm
    if voxel_mm is None:
        if median_depth_mm is None or not median_depth_mm > 0:
            raise ValueError("fusing without fusion.voxel_mm: the scene's median depth must be known")
        # Two digits: a clip cut at another frame gives the same.
        voxel_mm = float(f"{max(median_depth_mm / _VOXELS_PER_MEDIAN_DEPTH, _MIN_VOXEL_MM):.2g}")
    largest_mm = _VOXELS_PER_MAX_DEPTH * voxel_mm
    if median_depth_mm is not None and median_depth_mm > largest_mm:
        # Voxels that were set are so fine that most of the scene would be left out.
        largest_mm = _VOXELS_PER_MAX_DEPTH / _VOXELS_PER_MEDIAN_DEPTH * median_depth_mm
    return TsdfParameters(
        voxel_mm,
        settings.truncation_mm or round(_VOXELS_PER_TRUNCATION * voxel_mm, 4),
        settings.max_depth_mm or round(largest_mm, 4),
    )


def steepest_cosine(settings: FusionSettings) -> float:
    """Return the cosine of incidence below which neighbouring pixels are taken for two surfaces."""
    return _MIN_INCIDENCE if settings.weighted else _MIN_COSINE


class TsdfVolume:
    """An unbounded truncated signed distance field; `ValueError` where the parameters do not set `voxel_mm`."""

    def __init__(self, settings: FusionSettings, parameters: TsdfParameters | None = None) -> None:
        self.settings = settings
        self.parameters = parameters or choose_parameters(settings)
        self.finest_mm = self.parameters.voxel_mm
        """Edge of its voxels before they became larger, mm."""
        self._blocks = VoxelBlocks()
        self._painter = AlbedoPainter() if settings.without_light else None

    @property
    def block_count(self) -> int:
        """Number of blocks of 8^3 voxels in memory, 12 KiB each."""
        return len(self._blocks)

    def integrate(self, frame: Frame) -> None:
        """Fuse the valid pixels of a frame up to the largest depth; a frame without any changes nothing.

        Unless weights are off, frames count by image quality (`frame.quality`), pixels whose depth is less certain than
        the frame's median pixel (`frame.depth_sigma_mm`) count less. Small highlights within the picture count
        (their depth is that around them: `depth/under_highlights.py`), in the colour of what is around them.

        Raises `ValueError` for a frame without depth or pose, or with a pose that is not finite or too far away.
        """
        depth_mm, T_world_camera = self._checked(frame)
        if not self.block_count:
            self._widen(median_depth_of(frame) / max(frame.camera.fx, frame.camera.fy))
        camera, settings, parameters = frame.camera, self.settings, self.parameters
        T_camera_world = inverse(T_world_camera)
        R, t = np.ascontiguousarray(T_camera_world[:3, :3]), T_camera_world[:3, 3].copy()
        pinhole = TsdfCamera(R, t, float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        step = math.sqrt(1 / steepest_cosine(settings) ** 2 - 1) / min(camera.fx, camera.fy)
        # A share of 1: voxels have the full weight up to the truncation.
        shares = (_TRUNCATION_SHARE,) if settings.weighted else (0.0, 1.0)
        grid = Grid(parameters.voxel_mm, parameters.truncation_mm, step, *shares)
        masked = np.zeros_like(frame.valid)
        if settings.weighted and frame.highlights is not None:
            masked = small_highlights(frame.highlights)
        with np.errstate(invalid="ignore"):
            usable = (frame.valid | masked) & (depth_mm > 0) & (depth_mm <= parameters.max_depth_mm)
        least_incidence = _MIN_INCIDENCE if settings.weighted else 0.0
        inverse_depth = np.divide(1.0, depth_mm, out=np.full(depth_mm.shape, np.nan, np.float32), where=usable)
        surface = measure_surface(inverse_depth, pinhole, step, least_incidence, parameters.max_depth_mm)
        trust = depth_trust(np.where(usable, depth_mm, np.nan), frame.depth_sigma_mm, _DEPTH_SIGMA)
        weight = surface.weight * np.minimum(trust, np.float32(1.0))
        weight = weight * np.float32(frame.quality) if settings.weighted else (weight > 0).astype(np.float32)
        surface = surface._replace(weight=weight if frame.weight is None else weight * frame.weight)
        if self._painter is not None:
            picture = self._painter.paint(frame.rgb, surface, pinhole, self._blocks, parameters.voxel_mm)
        else:
            picture = np.dstack([frame.rgb, np.ones_like(frame.valid)]).astype(np.float32)
        if masked.any():
            _paint_masked(picture, masked)
        keys = np.unique(touched_blocks(surface.inverse_depth, pinhole, grid))
        slots = self._blocks.slots(keys)
        integrate_blocks(self._blocks.voxels, slots, unpack(keys) * BLOCK, surface, picture, pinhole, grid)

    def _widen(self, pixel_mm: float) -> None:
        """Make voxels larger, before the first frame, that are far finer than a pixel at the median depth, mm."""
        voxel_mm = float(f"{pixel_mm / _MOST_VOXELS_PER_PIXEL:.2g}")
        if voxel_mm > self.parameters.voxel_mm:
            truncation_mm = max(self.parameters.truncation_mm, round(_VOXELS_PER_TRUNCATION * voxel_mm, 4))
            self.parameters = self.parameters._replace(voxel_mm=voxel_mm, truncation_mm=truncation_mm)

    def coarsen(self) -> None:
        """Double the size of voxels, and the truncation."""
        self._blocks.halve()
        voxel_mm, truncation_mm = 2 * self.parameters.voxel_mm, 2 * self.parameters.truncation_mm
        self.parameters = self.parameters._replace(voxel_mm=voxel_mm, truncation_mm=truncation_mm)

    def extract_mesh(self) -> trimesh.Trimesh:
        """Return the surface seen so far, world mm, vertex colours, normals towards the camera's side; may be empty."""
        median_level = None if self._painter is None else self._painter.median_level
        return extract_mesh(self._blocks, self.settings, self.parameters.voxel_mm, median_level)

    def _checked(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        for name in ("depth_mm", "T_world_camera"):
            if getattr(frame, name) is None:
                raise ValueError(f"fusing frame {frame.index}: it has no {name}; fuse tracked frames with depth only")
        depth_mm, T_world_camera = np.asarray(frame.depth_mm, np.float32), np.asarray(frame.T_world_camera, np.float64)
        largest_mm = (KEY_OFFSET - 1) * BLOCK * self.parameters.voxel_mm
        largest_mm -= 4 * self.parameters.max_depth_mm + self.parameters.truncation_mm
        if not np.all(np.abs(T_world_camera[:3]) <= largest_mm):
            raise ValueError(
                f"fusing frame {frame.index}: its pose is not finite or over {largest_mm:.0f} mm from the origin; "
                "leave out lost frames or use a larger voxel"
            )
        return depth_mm, T_world_camera


def _paint_masked(picture: np.ndarray, masked: np.ndarray) -> None:
    """Give the masked pixels (H, W) bool of a picture (H, W, 4), r g b and weight, the mean colour around them."""
    picture[masked, 3] = 0
    some = np.ascontiguousarray(picture[::_EVERY_PX, ::_EVERY_PX])
    window = (2 * round(_SURROUNDINGS * some.shape[1] / 2) + 1,) * 2
    weight, colour = cv2.blur(some[..., 3], window), cv2.blur(some[..., :3] * some[..., 3:], window)
    rows, columns = np.nonzero(masked)
    near = rows // _EVERY_PX, columns // _EVERY_PX
    picture[rows, columns, :3] = colour[near] / np.maximum(weight[near], np.float32(1e-12))[:, None]
    picture[rows, columns, 3] = np.float32(_MASKED_COLOUR) * weight[near]


@dataclass(frozen=True)
class FusedSurface:
    """A surface, world mm, may be empty; the settings with the TSDF parameters that were used; notices about these."""

    mesh: trimesh.Trimesh
    settings: FusionSettings
    notices: list[Notice]


class SurfaceFusion:
    """Fuses tracked frames: after the last one where they are corrected then or voxels follow the scene, else at once.

    Voxels of what is fused at once, and not set, follow the first frame of a map.

    corrected : whether frames are corrected after the last one.
    """

    def __init__(self, settings: FusionSettings, store: FrameStore, *, corrected: bool) -> None:
        self.settings, self.store = settings, store
        self.at_end = corrected or (settings.enabled and settings.voxel_mm is None)
        """Whether frames are stored, and fused after the last one."""
        self.keeps_frames = False
        """Whether frames that are fused at once are stored, too: a run that is resumed takes them from there."""
        self.shown = False
        """Whether the surface so far is looked at: frames are then fused at once, too, and anew after the last one."""
        self.most_blocks: int | None = None
        """Blocks in all volumes beyond which nothing more is fused at once, and voxels of stored frames become larger;
        None: no limit."""
        self.coarser_beyond: int | None = None
        """Blocks in all volumes beyond which their voxels become larger; None: no limit."""
        self._volumes = dict[int, TsdfVolume]()
        self._selector = FrameSelector(settings.every)

    @property
    def at_once(self) -> bool:
        """Whether frames are fused as they come."""
        return self.settings.enabled and (self.shown or not self.at_end)

    @property
    def is_full(self) -> bool:
        """Whether the volumes of frames fused at once are as large as they may be."""
        blocks = sum(volume.block_count for volume in self._volumes.values())
        return self.most_blocks is not None and blocks >= self.most_blocks

    def surface(self, map_number: int) -> trimesh.Trimesh:
        """Return the surface of a map's frames fused at once so far, not finished; empty where there are none."""
        volume = self._volumes.get(map_number)
        return trimesh.Trimesh() if volume is None else volume.extract_mesh()

    def copied(self, map_number: int) -> TsdfVolume | None:
        """Return a copy of the volume of a map's frames fused at once; None where there is none."""
        return deepcopy(self._volumes.get(map_number))

    def forget(self, map_number: int) -> None:
        """Drop the volume of a map's frames fused at once."""
        self._volumes.pop(map_number, None)

    def put(self, frame: Frame, map_number: int = 0) -> None:
        """Store a frame, and fuse it in its map's volume if it has a pose and `FrameSelector` chooses it; or either."""
        if self.at_end or self.keeps_frames:
            self.store.put(frame)
        self.replay(frame, map_number)

    def replay(self, frame: Frame, map_number: int = 0) -> None:
        """Take a frame that is stored as `put` takes it: it is fused at once where frames are."""
        if not self.at_once or frame.T_world_camera is None or self.is_full:
            return
        if (chosen := self._selector.chosen(frame, map_number)) is not None:
            if map_number not in self._volumes:
                # Where voxels are set the largest depth follows them alone: the scene is not known yet.
                median_mm = None if self.settings.voxel_mm else median_depth_of(chosen)
                if median_mm is not None and not median_mm > 0:
                    return  # no pixel has a depth
                self._volumes[map_number] = TsdfVolume(self.settings, choose_parameters(self.settings, median_mm))
            self._volumes[map_number].integrate(chosen)
            _coarsen(list(self._volumes.values()), self.coarser_beyond)

    def stay_at_once(self) -> None:
        """Drop the stored frames: the surface stays what is fused at once."""
        self.at_end = False
        self.store.clear()

    def fuse(self, frames: Iterable[Frame], median_mm: float | None, map_number: int = 0) -> FusedSurface:
        """Return the surface of stored frames, as `FrameSelector` chose them, or of those fused at once.

        frames : all are consumed. median_mm : of the depth of those that the TSDF parameters follow. map_number : of
        those fused at once.
        """
        if self.at_end:
            self._volumes.clear()  # of frames that were not corrected
        volume, settings = self._volumes.get(map_number), self.settings
        if self.at_end and settings.enabled and (median_mm or settings.voxel_mm):
            volume = TsdfVolume(settings, choose_parameters(settings, median_mm))
        limit = self.most_blocks if self.coarser_beyond is None else self.coarser_beyond
        for frame in frames:
            if volume is not None:
                volume.integrate(frame)
                _coarsen([volume], limit)
        if volume is None:
            return FusedSurface(trimesh.Trimesh(), settings, [])
        notices = [] if settings.voxel_mm is not None else [volume.parameters.notice]
        if volume.parameters.voxel_mm > volume.finest_mm:
            sizes = {"voxel_mm": volume.parameters.voxel_mm, "finest_mm": volume.finest_mm}
            notices = [Notice("fusion-coarsened", sizes)]
        if settings.voxel_mm is not None and volume.parameters.max_depth_mm > choose_parameters(settings).max_depth_mm:
            depths = {"max_depth_mm": volume.parameters.max_depth_mm, "median_mm": median_mm}
            notices.append(Notice("fusion-farther", depths))
        used = settings.model_copy(update=volume.parameters._asdict())
        return FusedSurface(volume.extract_mesh(), used, notices)


def _coarsen(volumes: list[TsdfVolume], most_blocks: int | None) -> None:
    """Make the voxels of the largest volume larger until all are within the limit."""
    while most_blocks is not None and sum(volume.block_count for volume in volumes) > most_blocks:
        max(volumes, key=lambda volume: volume.block_count).coarsen()


def depth_notices(medians_mm: list[float], settings: FusionSettings) -> list[Notice]:
    """Return a notice where most of the scene, by its frames' median depths, is beyond the depth that is fused."""
    if not settings.enabled or not medians_mm or settings.max_depth_mm is None:
        return []
    median_mm = float(np.median(medians_mm))
    if median_mm <= settings.max_depth_mm:
        return []
    return [Notice("fusion-too-far", {"median_mm": median_mm, "max_depth_mm": settings.max_depth_mm})]
