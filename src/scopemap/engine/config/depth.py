"""Settings of depth, its consistency over time, and the networks."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from scopemap.engine.config.settings import Methods, Settings, StageSettings, advanced


class DepthSettings(StageSettings):
    """Where depth comes from and what fixes its scale."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "paper": {"fit": "pseudo-stereo"},
        "no-disparity-floor": {"fit": "pseudo-stereo-all"},
        "network-focal": {"depth_pro_focal": "network"},
        "realtime": {"network_every": 2},
    }
    method: str = Field("scopemap", description="chooses advanced settings (below): scopemap, realtime, paper, ...")
    backend: str = Field(
        "scopenet",
        description="depth estimator: one that `scopemap run --help` names at `--depth`, files:FOLDER, or stereo (of "
        "input.stereo=use)",
    )
    model: str = Field(
        "", description="weights of the network: hub id or folder, for scopenet a .onnx file; empty: the default"
    )
    anchor_model: str = Field("", description="weights of Depth Pro as anchor, hub id or folder; empty: the default")
    anchor: Literal["auto", "near-far", "depth-pro", "shading", "factor"] = Field(
        "auto",
        description="metric anchor in frame 1; auto: near-far where given, else the network's own mm, else shading",
    )
    near_far_mm: tuple[float, float] | None = Field(
        None, description="nearest and farthest tissue in frame 1, mm; replaces a preset's anchor by near-far"
    )
    shading_median_mm: float = Field(
        35.0, gt=0, description="anchor = shading: assumed median distance of tissue in frame 1, mm"
    )
    files_kind: Literal["auto", "disparity", "depth", "measured"] = Field(
        "auto",
        description="kind of depth files, disparity: near is large; depth: predicted, scale may float; auto: 8 bit is "
        "disparity, of others the first frames decide between disparity and measured",
    )
    files_scale_mm: float | None = Field(
        None, gt=0, le=1e6, description="mm per unit of depth files; unset: from the calibration, else 1"
    )
    max_depth_mm: float = Field(
        300.0, gt=0, description="predicted depth beyond this is unknown, unless near-far names a farther one, mm"
    )

    fit: Literal["scale-and-shift", "pseudo-stereo", "pseudo-stereo-all"] = advanced(
        "scale-and-shift",
        "what is fitted to the anchor, pseudo-stereo: the baseline of the paper, without pixels below a tenth of the "
        "largest disparity (the far end); pseudo-stereo-all: with all that have a disparity (the paper)",
        "by hand",
    )
    depth_pro_focal: Literal["camera", "network"] = advanced(
        "camera",
        "focal length that scales Depth Pro's depth: the camera's, or the one that Depth Pro finds (the paper)",
        "Depth Pro's formula, depth = f / (W c)",
    )
    network_every: PositiveInt = advanced(
        1, "the network looks at every n-th frame; flow carries its depth to those between", "the paper: every frame"
    )
    factor: PositiveFloat = advanced(
        30.0, "anchor = factor: the nearest tissue of frame 1 is at 1000 mm / factor", "table 3 of the paper"
    )

    @property
    def is_anchored(self) -> bool:
        """Whether a range, another estimator or a factor fixes the millimetres of frame 1, not the estimate itself."""
        return self.near_far_mm is not None or self.anchor not in ("auto", self.backend)


class MapisSettings(StageSettings):
    """Depth consistency over time: MAPIS-Depth of the paper."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "paper": {
            "frame_scale": "none",
            "order": "refine-first",
            "blend": "linear",
            "previous": "raw",
        },
        "no-flow-check": {"consistency_px": 0.0},
    }
    method: str = Field("scopemap", description="chooses advanced settings (below): scopemap, paper, ...")

    frame_scale: Literal["auto", "none", "robust"] = advanced(
        "auto",
        "scale of each frame's depth, robust: median ratio to the warped previous depth; none: 1 (the paper); auto: "
        "robust for predicted depth, none for measured",
        "by hand: a network's scale changes from frame to frame",
    )
    filter_sigma_px: NonNegativeFloat = advanced(
        2.0,
        "sigma_d of the bilateral filter, whose sigma_r is 2 mm; 0: off",
        "plausible, not searched; the paper gives none",
    )
    consistency_px: NonNegativeFloat = advanced(
        1.0, "largest forward-backward error of flow; 0: not checked (the paper)", "by hand"
    )
    order: Literal["track-first", "refine-first"] = advanced(
        "track-first",
        "refine-first: warp depth values unchanged, then track (the paper); track-first: move the warped depth by the "
        "tracked motion",
        "by hand: values change with the motion along the axis",
    )
    blend: Literal["auto", "none", "exponential", "linear", "constant", "paper-equation"] = advanced(
        "auto",
        "weight of the warped depth, with the perceptual distance S; linear: 1 - S; exponential: exp(-S / 0.15); "
        "constant: 0.5; paper-equation: S; auto: linear for predicted depth, none for measured",
        "linear: the paper's section MAPIS-Depth, by its text; better than exponential wherever it was tried",
    )
    previous: Literal["refined", "raw"] = advanced(
        "refined",
        "what a frame is blended with, refined: the refined previous depth, by a map of the perceptual distance to the "
        "warped previous image; raw: the raw one, by one distance to the previous image as it is (the paper)",
        "by hand",
    )


class NetworkSettings(Settings):
    """Optical flow, features and perceptual distance."""

    flow: str = Field(
        "dis",
        description="flow from frame to frame: one that `scopemap run --help` names at `--flow`",
    )
    keyframe_flow: str = Field(
        "dis",
        description="flow between keyframes and from the keyframe to the frame, the same names; none: no corners, "
        "and a back end without observations",
    )
    perceptual: Literal["lpips", "structure"] = Field(
        "structure",
        description="perceptual distance, structure: local structural similarity, no weights; lpips: AlexNet (with the "
        "extra `networks` and its weights)",
    )
    features: Literal["alike", "sift"] = Field(
        "alike",
        description="features for relocalisation, loop closure and map merging, alike: ALIKE-t, learned, part of the "
        "package; sift: OpenCV's",
    )
    device: str = Field(
        "auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?|mps|xpu)$",
        description="where networks run, auto: each where it can | cpu | cuda: all of them, or an error",
    )
