"""Every setting of every stage, with unit and source, and the presets; one file per part of the pipeline."""

from scopemap.config.config import Config, Preset, explain, setting_names
from scopemap.config.depth import DepthSettings, MapisSettings, NetworkSettings
from scopemap.config.input import InputSettings, MaskSettings
from scopemap.config.mapping import FusionSettings, MappingSettings
from scopemap.config.presets import PRESETS
from scopemap.config.settings import Settings
from scopemap.config.tracking import SmoothingSettings, TrackingSettings

__all__ = [
    "PRESETS",
    "Config",
    "DepthSettings",
    "FusionSettings",
    "InputSettings",
    "MapisSettings",
    "MappingSettings",
    "MaskSettings",
    "NetworkSettings",
    "Preset",
    "Settings",
    "SmoothingSettings",
    "TrackingSettings",
    "explain",
    "setting_names",
]
