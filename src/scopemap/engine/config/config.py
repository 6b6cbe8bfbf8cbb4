"""Every setting of every stage, with unit and source; presets `default`, `paper`, `paper-strict`, `realtime`.

Order of precedence: defaults < preset < TOML file < single settings (`--set fusion.every=2`); the preset itself may be
named by any of them. A range of depth (`depth.near_far_mm`) becomes the anchor unless the same source names another
one, and another `depth.backend` than the preset's does not get the preset's `depth.model`. An unknown key is an error
that names the nearest key. Each stage's `method` chooses its advanced settings; one that is given itself counts before
the method, but a later source that names a method replaces what earlier ones have for these.

"The paper" is arXiv 2508.11282. It publishes none of its constants: those of the tracker were chosen by trial on the
sequences of BENCHMARK.md; tau, the filter's sigmas, rho and WEMA's weights and omega are plausible values that were not
searched.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any, Final, Literal, cast

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from scopemap.engine.config.depth import DepthSettings, MapisSettings, NetworkSettings
from scopemap.engine.config.input import InputSettings, MaskSettings
from scopemap.engine.config.mapping import FusionSettings, MappingSettings
from scopemap.engine.config.presets import PRESETS
from scopemap.engine.config.settings import Settings, StageSettings, hint
from scopemap.engine.config.tracking import SmoothingSettings, TrackingSettings
from scopemap.engine.errors import SettingsError

Preset = Literal["default", "paper", "paper-strict", "realtime"]
_QUOTED = 80  # characters of a value that an error repeats
REMOVED: Final[dict[str, str]] = {
    "depth.reanchor_every": "",
    "mapping.moving_tissue": "",
    **{
        f"mask.{part.replace('-', '_')}": f"mask.method=no-{part}"
        for part in ("field-of-view", "highlights", "overlays", "exposure")
    },
    "fusion.weighted": "fusion.method=unweighted",
    "fusion.free_space": "fusion.method=no-free-space",
    **dict.fromkeys(("tracking.picture_checks", "tracking.pose_checks"), "tracking.checks"),
    **{
        f"tracking.{name}": "tracking.photometric"
        for name in ("start", "channels", "lamp_gamma", "gain_bias", "depth_weight")
    },
    **dict.fromkeys(("depth.fit_shift", "depth.disparity_floor"), "depth.fit"),
    **{f"mapis.{name}": "mapis.previous" for name in ("recursive", "compare_warped", "perceptual_score")},
    # Of the rest nobody chose a value: they are constants, with their last defaults.
    **{f"smoothing.{name}": "" for name in ("alpha", "beta", "gamma", "omega")},
    **{f"mapis.{name}": "" for name in ("filter_sigma_mm", "scale_pull", "sigma_fading", "tau", "constant_weight")},
    **{
        f"mapping.{name}": ""
        for name in (
            *("keyframe_gaps", "local_gaps", "correlated_observations", "depth_sigma_share", "scale_sigma"),
            *("rotation_sigma_deg", "translation_sigma_share"),
        )
    },
    **{
        f"tracking.{name}": ""
        for name in (
            *("min_texture", "min_sharpness", "min_correlation", "min_inlier_share", "max_step", "min_keyframe_motion"),
            *("keyframe_patience", "search_every", "max_iterations"),
        )
    },
    **{f"fusion.{name}": "" for name in ("min_incidence", "depth_sigma_share", "truncation_share", "min_weight")},
    **dict.fromkeys(("depth.shading_exponent", "mask.dark_level", "mask.files_grow_px"), ""),
}
"""Settings of earlier versions by their dotted names, and what took the place of each: a setting, where one value of it
did with that value; "" where nothing did."""


class RunSettings(Settings):
    """The run as a whole."""

    memory_mb: int | None = Field(
        None,
        ge=1,
        description="limit of memory, MB: fewer observations are adjusted, and voxels are larger, where more would be "
        "needed; default: none",
    )


class Config(Settings):
    """All settings of a run."""

    preset: Preset = "default"
    run: RunSettings = RunSettings()
    input: InputSettings = InputSettings()
    mask: MaskSettings = MaskSettings()
    depth: DepthSettings = DepthSettings()
    mapis: MapisSettings = MapisSettings()
    networks: NetworkSettings = NetworkSettings()
    tracking: TrackingSettings = TrackingSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    mapping: MappingSettings = Field(MappingSettings(), validate_default=True)
    fusion: FusionSettings = FusionSettings()

    @field_validator("mapping")
    @classmethod
    def _of_camera(cls, mapping: MappingSettings, before: ValidationInfo) -> MappingSettings:
        """Return what is adjusted: of a camera at rest there is nothing to adjust."""
        tracking = before.data.get("tracking")  # missing where it is wrong itself
        return MappingSettings(method="none") if tracking and tracking.camera_at_rest else mapping

    @classmethod
    def load(
        cls,
        preset: Preset | None = None,
        file: Path | None = None,
        settings: dict[str, Any] | None = None,
        unknown: list[str] | None = None,
    ) -> Config:
        """Return the defaults, changed by a preset, then a TOML file, then dotted single settings.

        `settings` maps names such as "fusion.every" to values or to their text. The preset is the one that they
        name, else `preset`, else the one that the file names. `unknown` takes the names in the file that are none of a
        setting, and these are ignored. Raises `SettingsError`.
        """
        settings = settings or {}
        in_file = {} if file is None else _read_toml(file)
        if unknown is not None:
            unknown += sorted(in_file.keys() - set(setting_names()))
            in_file = {name: value for name, value in in_file.items() if name not in unknown}
        else:
            _check_file(file, in_file)
        chosen = str(settings.get("preset") or preset or in_file.get("preset") or "default")
        if chosen not in PRESETS:
            raise SettingsError(f"unknown preset '{chosen}': choose one of {', '.join(PRESETS)}")
        tree: dict[str, Any] = {}
        for key, value in _merged(PRESETS[chosen], in_file, settings, {"preset": chosen}).items():
            _insert(tree, key, value)
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            raise SettingsError("; ".join(map(explain, error.errors()))) from None

    @classmethod
    def chosen(cls, config: Config | str | None) -> Config:
        """Return settings as they are, those of the preset of that name, or the defaults. Raises `SettingsError`."""
        if isinstance(config, cls):
            return config
        if config is None or isinstance(config, str):
            return cls.load(cast("Preset | None", config))
        raise SettingsError(f"{str(config)[:_QUOTED]} holds no settings: give a Config, or the name of a preset")

    def toml(self) -> str:
        """Return all settings as TOML text that `load` reads back; settings of None are left out."""
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


def _merged(preset: dict[str, Any], *others: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a preset and of other sources, of which later ones win.

    Another backend does not get the preset's weights, a range of depth replaces an earlier anchor, the use of two views
    an earlier backend, and a method what earlier sources have for the advanced settings of its stage.
    """
    methods_advanced = _advanced_of_methods()
    flat = dict(preset)
    for source in others:
        if str(source.get("input.stereo", "")).startswith("use"):
            source = {"depth.backend": "stereo"} | source
        other_network = source.get("depth.backend") not in (None, preset.get("depth.backend"))
        if other_network and flat.get("depth.model") == preset.get("depth.model"):
            flat.pop("depth.model", None)
        replaced = {name for method in source.keys() & methods_advanced.keys() for name in methods_advanced[method]}
        flat = {name: value for name, value in flat.items() if name not in replaced} | source
        has_range = source.get("depth.near_far_mm") is not None and "depth.anchor" not in source
        if has_range and flat.get("depth.anchor", "auto") != "auto":
            flat["depth.anchor"] = "near-far"
    return flat


def _advanced_of_methods() -> dict[str, frozenset[str]]:
    """Return the dotted names of the advanced settings that each stage's method chooses, by that of the method."""
    stages = [(stage, part) for stage, part in Config() if isinstance(part, StageSettings)]
    return {f"{stage}.method": frozenset(f"{stage}.{name}" for name in part.sources()) for stage, part in stages}


def check_setting(dotted: str) -> None:
    """Raise `SettingsError` for a name that is none of a setting; it says which are near, and which its group has."""
    if dotted in (names := setting_names()):
        return
    group = dotted.partition(".")[0] + "."
    if dotted in REMOVED:
        raise SettingsError(f"unknown setting '{dotted}': {_instead(dotted)}")
    others = [name.removeprefix(group) for name in names if name.startswith(group)]
    of_group = f" {group[:-1]} has {', '.join(others)}" if others else ""
    raise SettingsError(f"unknown setting '{dotted}': {hint(dotted, names)}{of_group}")


def _check_file(file: Path | None, in_file: dict[str, Any]) -> None:
    """Raise `SettingsError` for a file of another version, with all its names that are none of a setting."""
    unknown = sorted(in_file.keys() - set(setting_names()))
    if not set(unknown) & REMOVED.keys():  # a misspelt one
        return
    words = ", ".join(f"{name} ({_instead(name)})" for name in unknown)
    raise SettingsError(f"{file} is of another version of scopemap. Delete the lines of these settings: {words}")


def _instead(name: str) -> str:
    if name not in REMOVED:
        return "unknown"
    return f"removed, use {REMOVED[name]}" if REMOVED[name] else "removed, nothing takes its place"


def _insert(tree: dict[str, Any], dotted: str, value: Any) -> None:
    check_setting(dotted)
    *groups, name = dotted.split(".")
    for group in groups:
        tree = tree.setdefault(group, {})
    tree[name] = value


def _read_toml(file: Path) -> dict[str, Any]:
    """Return the settings in a file by their dotted names."""
    try:
        return _flatten(tomllib.loads(Path(file).read_text(encoding="utf-8")))
    # Tables in tables without end, and numbers of thousands of digits, have errors of their own.
    except (OSError, RecursionError, ValueError) as error:
        raise SettingsError(f"cannot read the settings in {file}: {error}") from None


def explain(error: Any) -> str:
    """Return one phrase for an error that pydantic found: which setting, what is wrong, what was given."""
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "literal_error":
        choices = [choice for choice in re.findall(r"'[^']*'", error["ctx"]["expected"]) if choice != "''"]
        unknown = f"unknown {where.rpartition('.')[2]} {_quoted(error['input'])}"
        return f"setting '{where}': {unknown}: choose one of {', '.join(choices)}"
    return f"setting '{where}': {error['msg'].removeprefix('Value error, ')} (got {_quoted(error['input'])})"


def _quoted(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."
