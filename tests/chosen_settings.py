"""Settings in which constants of the stages are replaced, too."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

from scopemap.engine.config import Config, Preset, setting_names
from scopemap.engine.config.settings import StageSettings

Stage = TypeVar("Stage", bound=StageSettings)


def chosen(stage: type[Stage] | Stage, **values: Any) -> Stage:
    """Return settings of a stage, the default ones of a class, with the settings and constants that `values` names."""
    before = stage.model_validate({}) if isinstance(stage, type) else stage
    constants = {
        name: values.pop(name) for name in [field.name for field in fields(before.constants)] if name in values
    }
    changed = type(before).model_validate(before.model_dump() | values)
    base = before.constants if "method" not in values else changed.constants
    return changed.model_copy(update={"constants": replace(base, **constants)})


def configured(settings: dict[str, Any], preset: Preset | None = None) -> Config:
    """Return `Config.load(preset, settings=settings)`; "tracking.huber" names the constant of a stage."""
    names = setting_names()
    config = Config.load(preset, settings={key: value for key, value in settings.items() if key in names})
    for key in settings.keys() - set(names):
        stage, *_, name = key.split(".")
        config = config.model_copy(update={stage: chosen(getattr(config, stage), **{name: settings[key]})})
    return config
