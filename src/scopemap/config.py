"""Every setting of every stage, with unit and source; presets `paper`, `default`, `realtime`.

Order of precedence: defaults < preset < TOML file < single settings (`--set tracking.huber=2`); the preset itself may
be named by any of them. An unknown key is an error that names the nearest key. METHOD below is arXiv 2508.11282;
it publishes none of its constants (section "WEMA-RTDL"), so values are ours: those of the tracker were chosen by trial
on the sequences of BENCHMARK.md; tau, the filter's sigmas, rho and WEMA's weights and omega are plausible values that
were not searched.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from scopemap.errors import SettingsError
from scopemap.presets import PRESETS

Preset = Literal["paper", "default", "realtime"]
RENAMED_GROUPS = {"odometry": "tracking", "backend": "mapping"}
RENAMED: dict[str, str] = {}
"""Settings of earlier versions by what they are called now, with the group's new name on both sides."""


class Settings(BaseModel):
    """A group of settings: frozen, validated, no unknown key."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class InputSettings(Settings):
    """How the input is read."""

    camera_fit: str = Field(
        "exact",
        pattern=r"^(exact|scale|crop:\d+,\d+)$",
        description="what a calibration of another size means, exact: refused; scale: the images were resized from its "
        "size; crop:X,Y: they were cut out of it, X px from the left, Y px from the top",
    )
    focal: Literal["auto", "assume", "flow"] = Field(
        "auto",
        description="focal length of an unknown camera, assume: by the assumed field of view; flow: from the motion "
        "of the first frames; auto: flow where that tells it, Depth Pro's where that is in use",
    )
    stereo: Literal["auto", "none", "left-right", "top-bottom"] = Field(
        "auto",
        description="two views in one picture, of which the left or upper is used; auto: told from a video's pictures",
    )
    deinterlace: bool = Field(False, description="one field of each picture only, its missing rows interpolated")
    fps: float | None = Field(None, gt=0, description="at most so many frames per second, by the time stamps")
    skip_duplicates: bool = Field(True, description="leave out pictures of a video that repeat the one before")


class MaskSettings(Settings):
    """Which pixels count as usable tissue."""

    field_of_view: bool = Field(True, description="find the circular or octagonal field of view and black borders")
    dark_level: int = Field(12, ge=0, le=255, description="grey level up to which a pixel counts as under-exposed")
    bright_level: int = Field(240, ge=0, le=255, description="level at which the second-brightest channel is saturated")
    highlights: bool = Field(True, description="find specular highlights and leave them out")
    highlight_ratio: float = Field(1.5, gt=1, description="darkest channel over its local median in a highlight")
    highlight_grow_px: int = Field(2, ge=0, description="px by which a highlight is widened")
    border_px: int = Field(3, ge=0, description="px by which the field of view is shrunk")
    overlays: bool = Field(True, description="find burned-in text and logos, which stay while all else moves")
    files: str = Field(
        "",
        description="folder of masks, one image per frame, found by the number in its name: what is not 0 is left out "
        "(instruments, overlays); empty: the data set's own where it has some; none: without",
    )
    files_grow_px: int = Field(3, ge=0, description="px by which these masks are widened")


class DepthSettings(Settings):
    """Where depth comes from and what fixes its scale."""

    backend: str = Field("scopenet", description="scopenet | shading | depth-anything | depth-pro | files:FOLDER")
    model: str = Field(
        "",
        description="weights of the networks: hub id or local folder, for scopenet a .safetensors file; empty: pinned",
    )
    anchor: Literal["auto", "near-far", "depth-pro", "shading", "factor"] = Field(
        "auto", description="metric anchor of frame 1; auto: near-far if given, else the depth's own mm, else shading"
    )
    factor: float = Field(
        30.0,
        gt=0,
        description="anchor = factor: nearest tissue of frame 1 at 1000 mm over this (an ablation)",
    )
    reanchor_every: int = Field(
        0,
        ge=0,
        description="ask a metric anchor again every n-th frame (best a multiple of keyframe_every, with "
        "keyframe_agreement 0); 0: once",
    )
    near_far_mm: tuple[float, float] | None = Field(None, description="nearest and farthest tissue in frame 1, mm")
    fit_shift: bool = Field(True, description="fit scale and shift to the anchor; False: the paper's baseline only")
    files_kind: Literal["auto", "disparity", "depth", "measured"] = Field(
        "auto", description="auto: 8 bit is disparity, else measured depth; depth: predicted, its scale may float"
    )
    files_scale_mm: float | None = Field(None, gt=0, description="mm per unit of depth files; None: found or assumed")
    shading_median_mm: float = Field(35.0, gt=0, description="stated prior: median distance of tissue in frame 1, mm")
    shading_exponent: float = Field(0.6, gt=0, le=1, description="distance = k * brightness^-exponent")
    max_depth_mm: float = Field(
        300.0, gt=0, description="depth beyond this is unknown, unless measured or stated by near-far"
    )
    exponent: float | Literal["fit"] = Field(
        1.0,
        description="range of predicted depth about its median: distance^exponent; fit: from the flow, before the run",
    )
    exponent_frames: int = Field(80, ge=2, description="exponent = fit: how many frames at the start are looked at")

    @field_validator("exponent", mode="before")
    @classmethod
    def _number_or_fit(cls, value: Any) -> Any:
        """Refuse with one sentence; of a union pydantic would name every part."""
        try:
            possible = value == "fit" or 0.25 <= float(value) <= 4
        except (TypeError, ValueError):
            possible = False
        if not possible:
            raise ValueError("must be 'fit' or a number from 0.25 to 4")
        return value


class MapisSettings(Settings):
    """Depth consistency over time (METHOD section MAPIS-Depth)."""

    order: Literal["track-first", "refine-first"] = Field(
        "track-first", description="refine-first is the paper's: warp values as they are, then track"
    )
    frame_scale: Literal["auto", "none", "robust"] = Field(
        "auto", description="robust scale of each frame against the warped previous depth; auto: not for measured depth"
    )
    scale_pull: float = Field(
        0.1,
        ge=0,
        le=1,
        description="share of ln of that scale that is given up at a frame of which next to nothing is linked to the "
        "one before it; less, by the square, where more of what is usable is linked; 0: off",
    )
    blend: Literal["auto", "none", "exponential", "linear", "constant", "paper-equation"] = Field(
        "auto", description="weight of the warped depth; auto: linear, none for measured depth"
    )
    tau: float = Field(0.15, gt=0, description="LPIPS distance at which the exponential weight falls to 1/e")
    constant_weight: float = Field(0.5, ge=0, le=1, description="weight of the warped depth with blend = constant")
    sigma_fading: float = Field(
        0.3,
        ge=0,
        le=1,
        description="variance that warped depth gains per frame, share of what it lies below the frame's",
    )
    recursive: bool = Field(True, description="warp the refined previous depth; False: the unrefined, as the paper")
    compare_warped: bool = Field(True, description="LPIPS of the warped previous image; False: of the images as are")
    perceptual_score: bool = Field(False, description="one LPIPS score per pair instead of the map")
    filter_sigma_px: float = Field(2.0, ge=0, description="sigma_d of the bilateral filter, px; 0: off")
    filter_sigma_mm: float = Field(2.0, gt=0, description="sigma_r of the bilateral filter, mm")
    consistency_px: float = Field(1.0, gt=0, description="largest forward-backward flow error, px")


class NetworkSettings(Settings):
    """Flow and perceptual networks."""

    flow: str = Field(
        "auto",
        description="raft-small | raft-large | dis | none | auto: raft-small if at hand, else dis",
    )
    flow_iterations: int = Field(12, ge=1, description="RAFT's refinement steps")
    perceptual: Literal["auto", "lpips", "structure"] = Field(
        "auto", description="lpips: AlexNet; structure: local structural similarity, no weights; auto: what is at hand"
    )
    device: str = Field("auto", description="auto | cpu | cuda")


class TrackingSettings(Settings):
    """Tracking against the keyframe (METHOD section WEMA-RTDL)."""

    keyframe_every: int = Field(
        10, ge=1, description="every n-th frame becomes a keyframe (the paper's first alpha: 2)"
    )
    keyframe_agreement: float = Field(
        0.7,
        ge=0,
        le=1,
        description="a frame becomes a keyframe before its turn where it agrees with the last one in less than this "
        "share of what the first one tracked against it did: a fast camera must not lose it; 0: off",
    )
    levels: int = Field(5, ge=1, description="pyramid levels, factor 0.5")
    finest_level: int = Field(1, ge=0, description="0: full working size, 1: half")
    min_side_px: int = Field(16, ge=4, description="no level with a shorter side than this")
    rotation_first: bool = Field(True, description="SO(3) only at the coarsest level")
    solver: Literal["dogleg", "gauss-newton"] = "dogleg"
    max_iterations: int = Field(30, ge=1, description="steps per level")
    radius: float = Field(0.1, gt=0, description="rho, first trust radius: rad, and translation over mean depth")
    huber: float = Field(1.0, gt=0, description="Huber threshold in robust standard deviations (MAD)")
    channels: Literal["grey", "normalised", "both"] = Field(
        "both",
        description="what is compared: grey values, or grey values minus local mean over local deviation, or both",
    )
    normalise_sigma_px: float = Field(2.0, gt=0, description="width of the local mean, px at each level")
    grey_share: float = Field(0.3, gt=0, description="weight of the grey channel against the normalised one")
    lamp_gamma: float = Field(
        0.35,
        ge=0,
        description="grey = (cosine / distance^2)^gamma; sRGB alone: 0.45; 0.35 did better; 0: off",
    )
    depth_sigma_share: float = Field(
        0.05, gt=0, description="relative error that all depth has anyhow: more uncertain pixels count less; large: off"
    )
    depth_share: float = Field(
        1.0,
        ge=0,
        description="weight of the distance to the frame's own depth where that is measured, point to plane; 0: off",
    )
    least_depth_sigma: float = Field(
        1e-3, gt=0, description="least standard deviation of that distance, share of the keyframe's mean depth"
    )
    gain_bias: bool = Field(True, description="estimate gain and bias of each frame pair")
    flow_contradiction: float = Field(
        2.0,
        ge=0,
        description="flow from the frame before decides where a pose errs against it by more than this many times what "
        "the best motion does, and a pixel; only where MAPIS links frames, as it does for predicted depth; 0: off",
    )
    flow_least_share: float = Field(
        0.1, ge=0, le=1, description="flow has no say where less of a frame is linked to the one before it"
    )
    least_detail: float = Field(
        0.6, ge=0, description="a frame that shows less of the usual detail, and agrees badly, is lost; 0: off"
    )
    doubtful_inlier_share: float = Field(0.6, ge=0, le=1, description="less than that agrees badly")
    remembered_keyframes: int = Field(10, ge=0, description="among which a lost camera is looked for; 0: off")
    new_map_after: int = Field(5, ge=0, description="so many clear frames lost in a row, a new map begins; 0: never")
    least_landmarks: int = Field(20, ge=6, description="that must agree on where the camera was found again")
    corner_depth_share: float = Field(
        0.2,
        ge=0,
        description="relative error of predicted depth, for corners of the keyframe that flow follows; 0: off",
    )
    start: Literal["identity", "previous", "velocity"] = Field("previous", description="first guess of a frame")
    min_inlier_share: float = Field(0.4, ge=0, le=1, description="a frame below is lost; unrelated fine texture: 0.37")
    min_correlation: float = Field(0.15, ge=-1, le=1, description="with the keyframe; a frame below is lost; -1: off")
    min_valid_share: float = Field(0.1, ge=0, le=1, description="a frame with less usable overlap is lost")
    max_step: float = Field(0.5, gt=0, description="largest jump between frames: rad, and mm over mean depth")


class SmoothingSettings(Settings):
    """WEMA: weighted mean of the last three poses, on the group (METHOD section WEMA)."""

    method: Literal["none", "wema"] = "none"
    alpha: float = Field(0.6, ge=0, le=1, description="weight of pose i")
    beta: float = Field(0.3, ge=0, le=1, description="weight of pose i-1")
    gamma: float = Field(0.1, ge=0, le=1, description="weight of pose i-2")
    omega: float = Field(0.1, gt=0, description="s = 1 - exp(-i omega); frames count from 0")
    dynamic: bool = Field(True, description="False: s = 1 (the paper's ablation without DyEMA)")

    @model_validator(mode="after")
    def _weights_sum_to_one(self) -> SmoothingSettings:
        total = self.alpha + self.beta + self.gamma
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"alpha + beta + gamma must be 1, got {total:g}")
        return self


class MappingSettings(Settings):
    """Adjustment of all keyframes together, once the last frame is tracked."""

    method: Literal["none", "full"] = Field(
        "full",
        description="none: poses as tracked, frame by frame; full: all keyframes adjusted at the end, where depth is "
        "predicted (measured depth tracks as well or better without)",
    )
    gaps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5, 8), min_length=1, description="keyframes are linked to those so many before them"
    )
    cell_px: int = Field(16, ge=4, description="one point in each cell of that size")
    consistency_px: float = Field(1.0, gt=0, description="largest error of flow there and back")
    loop_landmarks: int = Field(
        25, ge=0, description="that must agree where a keyframe shows an old place; 0: no loops, no joining of maps"
    )
    depth_share: float = Field(0.15, gt=0, description="relative error that all depth has anyhow")
    scale_sigma: float = Field(0.1, gt=0, description="standard deviation of ln of a keyframe's depth scale")
    depth_step_sigma: float = Field(
        0.1, ge=0, description="how depth may be bent, ln from node to node of a coarse grid; 0: only scaled"
    )
    turn_sigma_deg: float = Field(3.0, gt=0, description="how far tracked turns between keyframes are trusted")
    way_sigma_share: float = Field(0.1, gt=0, description="the same of ways, over the mean depth")
    max_sigma_px: float = Field(
        0.8, gt=0, description="poses stay as tracked where points seen again stay farther off (robust deviation)"
    )
    max_depth_change: float = Field(
        0.3, gt=0, description="the same where points ask for more than that change of ln depth (their median)"
    )


class FusionSettings(Settings):
    """Volumetric fusion. Sizes that are not set follow the scene: see `scopemap.fusion.tsdf_parameters`."""

    enabled: bool = True
    voxel_mm: float | None = Field(None, ge=0.01, description="by default from the clip's median depth")
    truncation_mm: float | None = Field(None, ge=0.05, description="by default 5 voxels")
    max_depth_mm: float | None = Field(None, gt=0, description="depth beyond this is not fused; by default 200 voxels")
    min_incidence: float = Field(0.1, ge=0, le=1, description="cosine of incidence below which a pixel is not fused")
    depth_sigma_share: float = Field(
        0.2, gt=0, description="as odometry's; no pixel counts more than without an uncertainty; large: off"
    )
    min_weight: float = Field(1.5, ge=0, description="voxels with less weight give no surface")
    min_component_share: float = Field(0.02, ge=0, le=1, description="floaters below this share of the faces go")
    every: int = Field(1, ge=1, description="fuse every n-th tracked frame")


class Config(Settings):
    """All settings of a run."""

    preset: Preset = "default"
    input: InputSettings = InputSettings()
    mask: MaskSettings = MaskSettings()
    depth: DepthSettings = DepthSettings()
    mapis: MapisSettings = MapisSettings()
    networks: NetworkSettings = NetworkSettings()
    tracking: TrackingSettings = TrackingSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    mapping: MappingSettings = MappingSettings()
    fusion: FusionSettings = FusionSettings()

    @classmethod
    def load(
        cls, preset: Preset | None = None, file: Path | None = None, settings: dict[str, Any] | None = None
    ) -> Config:
        """Return the defaults, changed by a preset, then a TOML file, then dotted single settings.

        `settings` maps names such as "tracking.huber" to values or to their text. The preset is the one that they
        name, else `preset`, else the one that the file names. Raises `SettingsError`.
        """
        settings = settings or {}
        # A result folder of an earlier version is still a valid settings file.
        in_file = {} if file is None else {new_name(key): value for key, value in _flatten(_read_toml(file)).items()}
        chosen = str(settings.get("preset") or preset or in_file.get("preset") or "default")
        if chosen not in PRESETS:
            raise SettingsError(f"unknown preset '{chosen}': choose one of {', '.join(PRESETS)}")
        tree: dict[str, Any] = {}
        for key, value in (PRESETS[chosen] | in_file | settings | {"preset": chosen}).items():
            _insert(tree, key, value)
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            raise SettingsError("; ".join(explain(item) for item in error.errors())) from None

    def toml(self) -> str:
        """Return all settings as TOML text that `load` reads back; what is None is left out."""
        flat = _flatten(self.model_dump())
        return "".join(f"{key} = {_toml_value(value)}\n" for key, value in flat.items() if value is not None)


def setting_names() -> list[str]:
    """Return the dotted names of all settings."""
    return list(_flatten(Config().model_dump()))


def _toml_value(value: Any) -> str:
    # JSON's numbers, booleans, arrays and strings are TOML's too, but for surrogate pairs and a raw DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def new_name(setting: str) -> str:
    """Return what a setting of an earlier version is called now; other names as they are."""
    group, dot, name = setting.partition(".")
    setting = RENAMED_GROUPS.get(group, group) + dot + name
    return RENAMED.get(setting, setting)


def _insert(tree: dict[str, Any], dotted: str, value: Any) -> None:
    names = setting_names()
    if new_name(dotted) != dotted:
        raise SettingsError(f"setting '{dotted}' is now called '{new_name(dotted)}'")
    if dotted not in names:
        near = difflib.get_close_matches(dotted, names, n=1, cutoff=0.3)
        raise SettingsError(f"unknown setting '{dotted}'" + (f": did you mean '{near[0]}'?" if near else ""))
    *groups, name = dotted.split(".")
    for group in groups:
        tree = tree.setdefault(group, {})
    tree[name] = value


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(file).read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"cannot read the settings in {file}: {error}") from None


def explain(error: Any) -> str:
    """Return one phrase for an error that pydantic found: which setting, what is wrong, what was given."""
    where = ".".join(str(part) for part in error["loc"])
    return f"setting '{where}': {error['msg'].removeprefix('Value error, ')} (got {error['input']!r})"
