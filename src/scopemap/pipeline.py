"""The story: how one frame after the other becomes poses, depth and a surface.

    frame -> mask -> raw depth -> track against the keyframe (RTDL) -> refine depth with the motion known (MAPIS)
          -> smooth (WEMA) -> fuse (TSDF)

Fusion waits until the last frame is tracked where there is a back end, which adjusts all keyframes together first, and
where the voxels are to follow the scene. The `paper` preset does neither, and refines before it tracks. Nothing here
reads or writes files, looks at the clock, draws or prints: that is the runner's work. `perceive` is what needs no
motion, so it may run a frame ahead of `step`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh

from scopemap.config import Config, DepthSettings, FusionSettings
from scopemap.depth.anchor import AnchoredDepth, max_depth_mm
from scopemap.depth.create import create_anchor, create_depth, files_folder
from scopemap.depth.estimate import DepthEstimator, DepthKind
from scopemap.depth.files import FilesDepth
from scopemap.depth.mapis import DenseCorrespondence, Mapis, RefinedDepth
from scopemap.depth.perceptual import PerceptualDistance, create_perceptual
from scopemap.flow.consistency import pair_flow
from scopemap.flow.create import create_flow
from scopemap.flow.estimator import FlowEstimator
from scopemap.flow.follow import CornerFollower
from scopemap.frame import Correspondences2D3D, Frame
from scopemap.fusion import FrameSpool, TsdfVolume, choose_sizes, described, follows_scene, with_sizes
from scopemap.geometry.se3 import inverse
from scopemap.geometry.warp import carried_points, pull
from scopemap.io.sequence import Sequence
from scopemap.mapping import Mapper, Submap
from scopemap.masking.mask_files import MaskFiles, create_masks
from scopemap.masking.masker import Masker
from scopemap.tracking import FrameTracker, Track, Tracker, create_smoother


@dataclass(frozen=True)
class Percept:
    """What can be said of a frame before its motion is known.

    Attributes
    ----------
    frame : masked. raw_mm : (H, W) float32, anchored but not yet consistent, NaN = unknown. kind : of the estimate.
    link : correspondence with the frame before it, None for the first. anchored : whether the metric anchor was fitted
    to this very frame. raw_sigma_mm : (H, W) float32, one standard deviation of `raw_mm`, NaN = unknown; None: the
    estimator does not say.
    """

    frame: Frame
    raw_mm: np.ndarray
    kind: DepthKind
    link: DenseCorrespondence | None
    anchored: bool = False
    raw_sigma_mm: np.ndarray | None = None


@dataclass(frozen=True)
class Step:
    """What became of a frame: with its refined depth and, unless it is lost, its pose."""

    frame: Frame
    track: Track
    raw_mm: np.ndarray
    refined: RefinedDepth


@dataclass(frozen=True)
class Estimators:
    """The interchangeable parts that look at images."""

    depth: DepthEstimator
    anchor: AnchoredDepth
    flow: FlowEstimator
    keyframe_flow: FlowEstimator
    perceptual: PerceptualDistance
    masks: MaskFiles | None = None

    @classmethod
    def create(cls, config: Config, sequence: Sequence) -> Estimators:
        """Build what the settings name; raises what the parts raise where weights or files are missing."""
        networks, folder = config.networks, files_folder(config.depth)
        beside = folder is not None and folder.resolve() == sequence.path.resolve()
        return cls(
            create_depth(
                config.depth,
                sequence.depth_rectifier if beside else sequence.rectifier,
                networks.device,
                sequence.depth_scale_mm,
                calibrated=sequence.calibrated,
            ),
            create_anchor(config.depth, networks.device),
            create_flow(networks.flow, networks.device),
            create_flow(networks.keyframe_flow, networks.device),
            create_perceptual(networks.perceptual, networks.device),
            create_masks(config.mask, sequence.rectifier, sequence.source.masks),
        )

    def reach_mm(self, settings: DepthSettings, room: float = 1.0) -> float:
        """Return how far depth may reach, mm: `room` times the settings' word, or what files hold of measured depth."""
        measured_mm = self.depth.measured_max_mm if isinstance(self.depth, FilesDepth) else None
        return measured_mm or room * max_depth_mm(settings)

    def provenance(self) -> dict[str, str]:
        """Return names, versions and hashes of the parts, and what fixed the scale."""
        parts = self.depth.provenance()
        others: dict[str, DepthEstimator | FlowEstimator | PerceptualDistance] = {
            "flow": self.flow,
            "keyframe_flow": self.keyframe_flow,
            "perceptual": self.perceptual,
        }
        if self.anchor.reference.name == "depth-pro":
            others["anchor"] = self.anchor.reference
        for role, part in others.items():
            # Several parts have weights and hashes: each says whose.
            facts = part.provenance()
            parts |= {key if key == role else f"{role} {key}": value for key, value in facts.items()}
        masks = self.masks.provenance() if self.masks is not None else {}
        return parts | masks | {"anchor": self.anchor.description}


@dataclass(frozen=True)
class Fused:
    """Surface of a submap, world mm, may be empty; the settings with the sizes that it has; notes on these."""

    mesh: trimesh.Trimesh
    settings: FusionSettings
    note: list[str] = field(default_factory=list)


class Pipeline:
    """One run over one sequence; frames go through `perceive` and `step` in order, each once.

    `tracker` takes the place of ours, which `config.tracking` describes: for baselines and others' odometry.
    """

    def __init__(self, config: Config, estimators: Estimators, tracker: FrameTracker | None = None) -> None:
        self.config = config
        self.estimators = estimators
        self._masker = Masker(config.mask, estimators.masks)
        waits = config.mapping.method == "full" or follows_scene(config.fusion) or not config.fusion.enabled
        # Frames that are fused as they come cannot be sorted into maps at the end.
        own = config.tracking if waits else config.tracking.model_copy(update={"new_map_after": 0})
        self._tracker = tracker or Tracker(own)
        self._mapis = Mapis(config.mapis)
        self._smooth = create_smoother(config.smoothing)
        self._mapper = Mapper(config.mapping, create_flow(config.networks.keyframe_flow, config.networks.device))
        self._volume = None if waits else TsdfVolume(config.fusion)
        self._waiting = FrameSpool()
        self._previous: Frame | None = None
        self._last: Track | None = None
        self._last_mm: np.ndarray | None = None
        self._fusable = 0
        follows = tracker is None and config.tracking.corner_depth_share > 0 and estimators.keyframe_flow.name != "none"
        self._corners = (
            CornerFollower(estimators.keyframe_flow, config.mapis.advanced.consistency_px) if follows else None
        )

    def perceive(self, frame: Frame) -> Percept:
        """Mask a frame, estimate its raw depth and its correspondence with the frame before it."""
        frame = self._masker(frame)
        # A frame that the tracker is going to refuse must not fix the scale of the depth.
        usable = frame.valid.mean() >= self.config.tracking.min_valid_share
        shown = frame if usable else replace(frame, valid=np.zeros_like(frame.valid))
        estimate = self.estimators.depth.estimate(shown)
        raw = self.estimators.anchor.metric(estimate, shown)
        link = self._link(frame, estimate.kind)
        self._previous = frame
        just_fitted = self.estimators.anchor.just_fitted
        return Percept(frame, raw.depth_mm, estimate.kind, link, just_fitted, raw.sigma_mm)

    def step(self, percept: Percept) -> Step:
        """Track a frame, make its depth consistent, fuse it or let it wait until all are tracked."""
        refined = self._refine(percept, None) if self.config.mapis.paper.order == "refine-first" else None
        raw = replace(
            percept.frame,
            depth_mm=percept.raw_mm,
            depth_sigma_mm=percept.raw_sigma_mm,
            flow_correspondences=self._flow_correspondences(percept),
        )
        if self._corners is not None and percept.kind != "measured":
            raw = replace(raw, keyframe_correspondences=self._corners.find(raw))
        track = self._tracker.track(raw)
        elsewhere = track.status != "lost" and self._last is not None and track.map != self._last.map
        if elsewhere:
            # What is known of the frames just before is of another world.
            self._mapis.reset()
            self._smooth.reset()
        if refined is None:
            # What links a lost frame to its past cannot be trusted either.
            known = replace(percept, link=None) if track.status == "lost" or elsewhere else percept
            refined = self._refine(known, self._motion(track))
        frame = replace(percept.frame, depth_mm=refined.depth_mm, depth_sigma_mm=refined.sigma_mm)
        # Measured depth that was scaled or blended is not what the next frame measures.
        measured = percept.kind == "measured" and not self._mapis.links("measured")
        # Good depth tracks better by itself than flow over wide gaps would make it (BENCHMARK.md).
        track = self._keyed(track, frame, measured=measured, adjustable=percept.kind != "measured")
        if track.status == "lost":
            self._mapis.reset()
            self._smooth.reset()
        else:
            frame = replace(frame, T_world_camera=self._smooth(track.T_world_camera))
            self._fuse(frame)
        self._mapper.observe(track)
        self._last, self._last_mm = track, refined.depth_mm
        return Step(frame, track, percept.raw_mm, refined)

    def submaps(self) -> tuple[list[Submap], list[str]]:
        """Adjust all keyframes together after the last frame, and merge what can be merged; with warnings.

        Poses and depths that `step` gave away are as tracked: whoever kept them has to correct them.
        """
        return self._mapper.submaps()

    def fuse(self, submap: Submap) -> Fused:
        """Fuse what waited of a submap, in voxels that suit it, as the back end corrected it."""
        volume = self._volume_of(submap) if self._volume is None else self._volume
        if volume is None:
            return Fused(trimesh.Trimesh(), self.config.fusion)
        note = [f"fusion: {described(volume.sizes)}"] if follows_scene(self.config.fusion) else []
        return Fused(volume.extract_mesh(), with_sizes(self.config.fusion, volume.sizes), note)

    def _volume_of(self, submap: Submap) -> TsdfVolume | None:
        # Other maps' millimetres are not those of the main one.
        typical_mm = self._waiting.typical_mm(submap.main_frames)
        if typical_mm is None:
            return None
        volume = TsdfVolume(self.config.fusion, choose_sizes(self.config.fusion, typical_mm))
        for frame in self._waiting.frames():
            if frame.index in submap.frames:
                volume.integrate(frame if submap.correction is None else submap.correction.frame(frame))
        return volume

    def _keyed(self, track: Track, frame: Frame, *, measured: bool, adjustable: bool) -> Track:
        """Make the frame a keyframe where one is due; a first frame that cannot be one fixes no world and is lost."""
        if track.status == "lost" or not self._tracker.wants_keyframe():
            return track
        keyframe = replace(frame, T_world_camera=track.T_world_camera)
        adopted = self._tracker.adopt(keyframe, measured=measured)
        if adopted and self._corners is not None:
            self._corners.start(keyframe)
        if adopted and adjustable:
            self._mapper.add_keyframe(keyframe, track)
        if track.status == "initial" and not adopted:
            return replace(track, status="lost", reason="too little of its depth is known to start from")
        return track

    def _link(self, frame: Frame, kind: DepthKind) -> DenseCorrespondence | None:
        """Link a masked frame to the one before it; None for the first, and where MAPIS would not use it."""
        past, settings = self._previous, self.config.mapis
        if past is None or not self._mapis.links(kind):
            return None
        flow = pair_flow(self.estimators.flow, past.rgb, frame.rgb, settings.advanced.consistency_px)
        # What is masked in either frame shows no tissue that could be carried over.
        seen = pull(past.valid.astype(np.float32), flow.to_previous) > 0.5
        rgb = pull(past.rgb, flow.to_previous) if settings.paper.compare_warped else past.rgb
        distance = self.estimators.perceptual.compare(rgb, frame.rgb)
        values = np.full_like(distance.map, distance.score) if settings.paper.perceptual_score else distance.map
        return DenseCorrespondence(
            flow.to_previous, flow.consistent & seen & frame.valid, values, float(frame.valid.mean())
        )

    def _flow_correspondences(self, percept: Percept) -> Correspondences2D3D | None:
        """Return points of the frame before where flow finds them in this one; None where either is not known."""
        link = percept.link
        if link is None or self._last is None or self._last_mm is None or self._last.status == "lost":
            return None
        if self.estimators.flow.name == "none":
            # It holds that nothing moves, which is not for it to say.
            return None
        return carried_points(self._last_mm, link.to_previous, link.consistent, percept.frame.camera)

    def _refine(self, percept: Percept, T_current_previous: np.ndarray | None) -> RefinedDepth:
        return self._mapis.refine(
            percept.raw_mm,
            percept.kind,
            percept.frame.camera,
            percept.link,
            T_current_previous,
            sigma_mm=percept.raw_sigma_mm,
            anchored=percept.anchored,
        )

    def _motion(self, track: Track) -> np.ndarray | None:
        """Motion from the previous frame to this one, None unless both poses are known."""
        if self._last is None or "lost" in (track.status, self._last.status) or track.map != self._last.map:
            return None
        return inverse(track.T_world_camera) @ self._last.T_world_camera

    def _fuse(self, frame: Frame) -> None:
        if self.config.fusion.enabled and self._fusable % self.config.fusion.every == 0:
            if self._volume is None:
                self._waiting.put(frame)
            else:
                self._volume.integrate(frame)
        self._fusable += 1
