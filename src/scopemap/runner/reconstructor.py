"""The reconstructor: frames one at a time, from wherever they come, to poses, depth and a surface."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier, working_camera, working_size
from scopemap.engine.config import Config
from scopemap.engine.depth.estimate import DepthEstimator
from scopemap.engine.errors import SettingsError
from scopemap.engine.flow.estimator import CustomFlow
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Pipeline
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.input.source import ASSUMED_RATE_HZ, Source
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from scopemap.result.run_input import stated_input
from scopemap.result.verdict import state_verdict
from scopemap.runner.estimators import CustomEstimators, largest_depth_mm
from scopemap.runner.memory import memory_plan
from scopemap.runner.observers import FrameWriter, Progress
from scopemap.runner.preparation import prepare
from scopemap.runner.provenance import Limits, provenance_of, scale_facts
from scopemap.runner.run import Clock, KeptMaps, Run, overlapped


class Reconstructor:
    """Poses, depth and a surface of frames that come one at a time; the results are those of `reconstruct`.

    >>> camera = PinholeCamera(fx=280, fy=280, cx=159.5, cy=127.5, width=320, height=256)
    >>> with Reconstructor(Config.load("realtime"), camera) as reconstructor:
    ...     for picture in pictures:  # (256, 320, 3) uint8, sRGB
    ...         step = reconstructor.step(picture)
    ...         print(step.track.status, step.frame.T_world_camera)
    ...     result = reconstructor.result()

    source : the camera of the pictures, a pinhole or with a lens (`read_calibration`), or a `Sequence` from
        `open_sequence`, or the path of what it opens, whose frames come from `frames()`. config : settings, or the name
        of a preset, by default `default`.
    depth : depth estimator in place of the one of the settings: `CustomDepth(function, kind)`.
    flow : function of two pictures (H, W, 3) uint8 that returns the flow (H, W, 2) float, px, for that of the settings.
    progress : called with what is done before the first frame and in `result`, frames done, all frames (0: no count).
    limits : of memory, for runs without an end; beyond them results are no longer those of `reconstruct`.

    Raises `WeightsError`, `InputError` and `SettingsError` as `reconstruct` does, `SettingsError` for a depth or a flow
    that is none.
    """

    def __init__(
        self,
        config: Config | str | None,
        source: Sequence | Path | str | CameraModel,
        *,
        depth: DepthEstimator | None = None,
        flow: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
        progress: Progress = lambda doing, done, total: None,
        limits: Limits | None = None,
    ) -> None:
        if depth is not None and not hasattr(depth, "estimate"):
            raise SettingsError("depth is no estimator: state the kind of your function's values, CustomDepth(f, kind)")
        chosen = Config.chosen(config)
        if isinstance(source, Path | str):
            source = open_sequence(source, settings=chosen.input)
        self.config, clock = _with_own(chosen, depth=depth is not None, flow=flow is not None), Clock()
        self._pushed = not isinstance(source, Sequence)
        sequence = source if isinstance(source, Sequence) else _sequence_of(source, self.config)
        own = CustomEstimators(depth, None if flow is None else CustomFlow(flow))
        self._sequence, self.config, estimators, self._notices = prepare(
            sequence, self.config, clock.timed, progress, own
        )
        self._store = FrameStore()
        self._pipeline = Pipeline(self.config, estimators, self._store)
        self._pipeline.fusion.shown = True
        plan, kept = memory_plan(self.config, self._sequence), KeptMaps(limits or Limits())
        self._run = Run(self._sequence, self._pipeline, clock, (), progress, plan, kept)
        self._last, self._closed = -1, False

    @property
    def camera(self) -> PinholeCamera:
        """The working camera, which every frame carries."""
        return self._sequence.camera

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the sequence that it was made for, for `step`; none where it was made for a camera."""
        return iter(()) if self._pushed else self._sequence.frames()

    def step(self, picture: np.ndarray | Frame, time_s: float | None = None, index: int | None = None) -> Step:
        """Return pose, depth and status of the next frame, as tracked: a back end corrects them in `result`.

        picture : (h, w, 3) uint8, sRGB, of the camera's size; or a `Frame` of the working camera. time_s : its time, s,
        by default by number at 30 frames/s. index : its number, larger than those before; by default the next.

        The step's `frame.T_world_camera` is (4, 4), mm, camera to world, None where it is lost; `frame.depth_mm`
        (H, W) float32, mm, NaN = unknown; `frame.point_cloud()` its points in the world; `track.status` and
        `track.reason` say what happened. Raises `ValueError` for another shape or dtype, a number that does not
        increase, and after `result` or `close`.
        """
        step: Any = self._frame(picture, time_s, index)
        for part, call in self._pipeline.steps.items():
            step = self._run.clock.timed(part, call, step)
        self._run.take(step)
        return step

    def steps(
        self,
        pictures: Iterable[np.ndarray | Frame],
        *,
        ahead: int = 2,
        posed: Callable[[Step], None] = lambda step: None,
    ) -> Iterator[Step]:
        """Yield the step of each picture, the same as by `step`: stages overlap, each `ahead` frames ahead of the next.

        This is about twice as fast on two cores, and each step comes some frames after its picture was taken. posed :
        called with each step before it is fused, for whom the pose must not wait for the surface.
        """
        for step in overlapped((self._frame(picture) for picture in pictures), self._pipeline, self._run.clock, ahead):
            posed(step)
            self._run.take(step)
            yield step

    def surface(self) -> trimesh.Trimesh:
        """Return the surface of the current map so far, as tracked, world mm, with colours; empty without a frame.

        Voxels follow the map's first frame where `fusion.voxel_mm` is not set, and all frames in `result`. Nothing is
        fused while `steps` waits for a frame.
        """
        return self._pipeline.fusion.surface(self._run.kept_maps.map)

    def so_far(self, frames: FrameTable) -> tuple[Result, TsdfVolume | None]:
        """Return frames of the current map as a result without a surface, and a copy of the volume that extracts it.

        Copying takes far less time than extracting. None: nothing is fused, or not yet.
        """
        provenance = provenance_of(self._sequence, self._pipeline.estimators, {}, frames)
        volume = self._pipeline.fusion.copied(self._run.kept_maps.map)
        return Result.in_memory(self.camera, frames, trimesh.Trimesh(), self.config, provenance), volume

    def depth_writer(self, folder: Path) -> DepthWriter:
        """Return what writes the depth of frames to a result's folder, as `reconstruct` does."""
        return DepthWriter(folder, largest_depth_mm(self.config, self._pipeline.estimators))

    @property
    def surface_is_full(self) -> bool:
        """Whether nothing more is fused, by `Limits.blocks`."""
        return self._pipeline.fusion.is_full

    @property
    def scale_known(self) -> bool:
        """Whether the scale is measured or anchored; False: millimetres are a guess."""
        return bool(scale_facts(self._pipeline.estimators)["known"])

    def result(self, final: FrameWriter | None = None) -> Result:
        """Return poses, surface and the table of all frames, adjusted by the back end; the last call.

        final : called with each frame that is corrected, when its depth and pose are final.

        `trajectory.T_world_camera` holds the poses (N, 4, 4), NaN where lost; `mesh` vertices, faces and colours;
        `save(folder)` writes it. Raises `InputError` where no frame was tracked.
        """
        self._refuse_closed()
        self._run.writers = () if final is None else (final,)
        try:
            result = self._run.result(self._notices)
            result.provenance.update(stated_input(self._sequence.path, None))
            state_verdict(result)
            return result
        finally:
            self.close()

    def close(self) -> None:
        """Free what is kept on disk; `result` does so itself."""
        self._closed = True
        self._store.close()

    def __enter__(self) -> Reconstructor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _refuse_closed(self) -> None:
        if self._closed:
            raise ValueError("this reconstructor is closed: make another one")

    def _frame(self, picture: np.ndarray | Frame, time_s: float | None = None, index: int | None = None) -> Frame:
        self._refuse_closed()
        if isinstance(picture, Frame):
            if picture.camera != self.camera:
                raise ValueError("a frame of another camera: use reconstructor.frames(), or give the picture itself")
            frame = picture
        else:
            if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.ndim != 3:
                found = (
                    f"{picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
                )
                raise ValueError(f"expected a picture (h, w, 3) uint8, got {found}")
            rectifier, number = self._sequence.rectifier, self._last + 1 if index is None else index
            at_s = number / ASSUMED_RATE_HZ if time_s is None else time_s
            frame = Frame(number, at_s, rectifier.image(picture), self.camera, rectifier.valid)
        if frame.index <= self._last:
            raise ValueError(f"frame {frame.index} after frame {self._last}: numbers must increase")
        self._last = frame.index
        return frame


def _with_own(config: Config, *, depth: bool, flow: bool) -> Config:
    """Return settings that name own parts as "own"."""
    if depth:
        config = config.model_copy(update={"depth": config.depth.model_copy(update={"backend": "own", "model": ""})})
    if flow:
        networks = config.networks.model_copy(update={"flow": "own", "keyframe_flow": "own"})
        config = config.model_copy(update={"networks": networks})
    return config


def _sequence_of(camera: CameraModel, config: Config) -> Sequence:
    """Return a sequence without frames for pictures of a camera."""
    source = Source(Path("pictures"))
    source.name, source.width, source.height = "pictures", camera.width, camera.height
    size = working_size(camera.width, camera.height, config.input.longest_side_px)
    size_source = f"{size[0]}x{size[1]} px chosen for pictures of {camera.width}x{camera.height} px"
    rectifier = Rectifier(camera, working_camera(camera, size))
    return Sequence(source, source.path, rectifier, "given", size_source, calibrated=True)
