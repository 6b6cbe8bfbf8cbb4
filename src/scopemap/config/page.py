"""The page of settings, docs/settings.md, generated from the settings' classes.

`python -c "from scopemap.config.page import settings_page; print(settings_page(), end='')" > docs/settings.md`
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic.fields import FieldInfo

from scopemap.config.config import Config
from scopemap.config.presets import PRESETS
from scopemap.config.settings import Settings

_HEAD = """# Settings

Every setting can be set on the command line (`--set tracking.keyframe_every=5`), in a TOML file (`--config FILE`) or by
a preset. The order is defaults < preset < file < command line. A result's `config.toml` holds all settings and is a
valid file. A cell "presets" names what presets change;
`paper-strict` changes what `paper` does, too. `scopemap.config.page` writes this page.
"""
_SECTIONS = (
    ("", "User settings", "What one may want to choose."),
    (
        "advanced",
        "Advanced settings",
        "Values found by trial; the defaults are used in every preset that does not name them.",
    ),
    ("paper", "Settings of the paper", "What only the preset `paper` and the ablations need."),
)


def settings_page() -> str:
    """Return docs/settings.md: a table per stage, first the user settings, then `advanced`, then `paper`."""
    parts = [_HEAD]
    for group, title, meaning in _SECTIONS:
        parts.append(f"\n## {title}\n\n{meaning}\n")
        for stage, model in _stages():
            owner = model if not group else _nested(model).get(group)
            rows = [] if owner is None else list(_rows(owner, f"{stage}.{group}." if group else f"{stage}."))
            if rows:
                parts.append(f"\n### {stage}\n\n{_summary(model)}\n\n" if not group else f"\n### {stage}\n\n")
                parts.append("| setting | default | meaning | presets |\n|---|---|---|---|\n" + "".join(rows))
    return "".join(parts)


def _stages() -> Iterator[tuple[str, type[Settings]]]:
    yield from _nested(Config).items()


def _nested(model: type[Settings]) -> dict[str, type[Settings]]:
    """Return the groups of settings in a class by their names."""
    found = {name: field.annotation for name, field in model.model_fields.items()}
    return {name: kind for name, kind in found.items() if isinstance(kind, type) and issubclass(kind, Settings)}


def _rows(model: type[Settings], prefix: str) -> Iterator[str]:
    nested = _nested(model)
    for name, field in model.model_fields.items():
        if name not in nested:
            changes = [f"{preset}: {_text(values[prefix + name])}" for preset, values in _changes(prefix + name)]
            cells = (f"`{prefix}{name}`", _text(field.default), _meaning(field), "; ".join(changes))
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _changes(name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for preset, values in PRESETS.items():
        of_paper = preset == "paper-strict" and values.get(name) == PRESETS["paper"].get(name)
        if name in values and not of_paper:
            yield preset, values


def _meaning(field: FieldInfo) -> str:
    return " ".join((field.description or "").split())


def _text(value: Any) -> str:
    match value:
        case None:
            return "not set"
        case "":
            return "empty"
        case bool():
            return str(value).lower()
        case tuple():
            return ", ".join(_text(item) for item in value)
        case float():
            return f"{value:g}"
    return str(value)


def _summary(model: type[Settings]) -> str:
    return " ".join((model.__doc__ or "").split("\n\n")[0].split())
