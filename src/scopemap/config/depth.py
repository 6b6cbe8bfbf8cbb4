"""Settings of depth, its consistency over time, and the networks."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scopemap.config.settings import Settings


class DepthAdvanced(Settings):
    """Constants of the metric anchor and of shading depth."""

    reanchor_every: int = Field(
        0,
        ge=0,
        description="fit the metric anchor every n-th frame, best a multiple of keyframe_every; 0: once",
    )
    shading_exponent: float = Field(
        0.6, gt=0, le=1, description="inert unless depth is from shading: distance = k * brightness^-exponent"
    )


class DepthPaper(Settings):
    """What only the paper's preset and its ablations change."""

    fit_shift: bool = Field(True, description="fit scale and shift to the anchor; False: the pseudo-stereo baseline")
    disparity_floor: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="inert unless fit_shift = False: pixels below this share of the largest disparity (the far end) "
        "are left out of the baseline's fit; 0: only those without disparity (the paper)",
    )
    depth_pro_focal: Literal["camera", "network"] = Field(
        "camera",
        description="focal length that scales Depth Pro's depth, camera: of the frames' camera; network: the one that "
        "Depth Pro finds (the paper)",
    )
    factor: float = Field(
        30.0, gt=0, description="inert unless anchor = factor: nearest tissue of frame 1 is at 1000 mm / factor"
    )


class DepthSettings(Settings):
    """Where depth comes from and what fixes its scale."""

    backend: str = Field("scopenet", description="scopenet | shading | depth-anything | depth-pro | files:FOLDER")
    model: str = Field(
        "",
        description="weights of the network: hub id or folder, for scopenet a .onnx file; empty: the default",
    )
    anchor_model: str = Field(
        "", description="inert unless anchor = depth-pro: weights of Depth Pro, hub id or folder; empty: the default"
    )
    anchor: Literal["auto", "near-far", "depth-pro", "shading", "factor"] = Field(
        "auto",
        description="metric anchor in frame 1; auto: near-far where given, else the network's own mm, else shading",
    )
    near_far_mm: tuple[float, float] | None = Field(
        None, description="nearest and farthest tissue in frame 1, mm; replaces a preset's anchor by near-far"
    )
    shading_median_mm: float = Field(
        35.0, gt=0, description="inert unless the anchor is shading: assumed median distance of tissue in frame 1, mm"
    )
    files_kind: Literal["auto", "disparity", "depth", "measured"] = Field(
        "auto",
        description="kind of depth files; auto: 8 bit is disparity, else measured; depth: predicted, scale may float",
    )
    files_scale_mm: float | None = Field(
        None, gt=0, le=1e6, description="mm per unit of depth files; unset: from the calibration, else 1"
    )
    max_depth_mm: float = Field(
        300.0, gt=0, description="predicted depth beyond this is unknown, unless near-far names a farther one, mm"
    )
    downscale: int | None = Field(
        None,
        ge=1,
        le=32,
        description="estimate depth and make it consistent at the working size over this, inert for depth from files; "
        "unset: scopenet at about its training size, the longest side 160 to 319 px, others at the full one",
    )
    advanced: DepthAdvanced = DepthAdvanced()
    paper: DepthPaper = DepthPaper()


class MapisAdvanced(Settings):
    """Constants of depth consistency."""

    frame_scale: Literal["auto", "none", "robust"] = Field(
        "auto",
        description="scale of each frame's depth: robust: median ratio to the warped previous depth; none: 1; auto: "
        "robust for predicted depth, none for measured",
    )
    scale_pull: float = Field(
        0.1,
        ge=0,
        le=1,
        description="share of ln of that scale removed per frame where no pixel has a warped depth; decreases with the "
        "square of the warped share; 0: off",
    )
    sigma_fading: float = Field(
        0.3, ge=0, le=1, description="growth of the warped depth's variance per frame, share of its gap to the frame's"
    )
    filter_sigma_px: float = Field(2.0, ge=0, description="sigma_d of the bilateral filter, px; 0: off")
    filter_sigma_mm: float = Field(2.0, gt=0, description="sigma_r of the bilateral filter, mm")
    consistency_px: float = Field(1.0, gt=0, description="largest forward-backward error of flow, px")


class MapisPaper(Settings):
    """What only the paper's preset and its ablations change."""

    order: Literal["track-first", "refine-first"] = Field(
        "track-first", description="refine-first: warp depth values unchanged, then track (the paper)"
    )
    blend: Literal["auto", "none", "exponential", "linear", "constant", "paper-equation"] = Field(
        "auto", description="weight of the warped depth; auto: linear for predicted depth, none for measured"
    )
    tau: float = Field(
        0.15, gt=0, description="inert unless blend = exponential: LPIPS distance at which the weight is 1/e"
    )
    constant_weight: float = Field(
        0.5, ge=0, le=1, description="inert unless blend = constant: weight of the warped depth"
    )
    recursive: bool = Field(True, description="warp the refined previous depth; False: the raw one (the paper)")
    compare_warped: bool = Field(
        True, description="perceptual distance to the warped previous image; False: to the image as it is (the paper)"
    )
    perceptual_score: bool = Field(False, description="one perceptual score per pair instead of a map (the paper)")


class MapisSettings(Settings):
    """Depth consistency over time (METHOD section MAPIS-Depth)."""

    advanced: MapisAdvanced = MapisAdvanced()
    paper: MapisPaper = MapisPaper()


class NetworkSettings(Settings):
    """Optical flow, features and perceptual distance."""

    flow: str = Field(
        "dis",
        description="flow from frame to frame: dis | raft-small | raft-large (both with the extra `networks` and "
        "their weights) | none",
    )
    keyframe_flow: str = Field(
        "dis",
        description="flow between keyframes (back end) and from the keyframe to the frame (corners), the same names; "
        "none: no corners, and a back end without observations",
    )
    perceptual: Literal["lpips", "structure"] = Field(
        "structure",
        description="perceptual distance, structure: local structural similarity, no weights; lpips: AlexNet (with the "
        "extra `networks` and its weights)",
    )
    features: Literal["alike", "sift"] = Field(
        "alike",
        description="features by which a lost camera, loops and other maps are found again, alike: ALIKE-t, learned, "
        "part of the package; sift: OpenCV's",
    )
    device: str = Field(
        "auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?|mps|xpu)$",
        description="where the networks of the extra `networks` run: auto | cpu | cuda; scopenet: on the CPU",
    )
