"""Every setting of every stage, with unit and source, and the presets; one file per part of the pipeline."""

from scopemap.engine.config.config import Config, Preset, explain, setting_names
from scopemap.engine.config.depth import DepthSettings, MapisSettings, NetworkSettings
from scopemap.engine.config.input import InputSettings, MaskSettings
from scopemap.engine.config.mapping import FusionSettings, MappingSettings
from scopemap.engine.config.presets import PRESETS
from scopemap.engine.config.settings import Settings
from scopemap.engine.config.tracking import SmoothingSettings, TrackingSettings

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
