"""The page of settings, docs/settings.md, generated from the settings' classes: `python docs/settings_page.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scopemap.config import PRESETS, Config, Settings

_HEAD = """# Settings

Every setting can be set on the command line (`--set tracking.keyframe_every=5`), in a TOML file (`--config FILE`) or by
a preset. The order is defaults < preset < file < command line. A result's `config.toml` holds all settings and is a
valid file. A cell "presets" names what presets change; `paper-strict` changes what `paper` does, too.
`python docs/settings_page.py` writes this page.
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
        for stage, model in _nested(Config).items():
            owner = model if not group else _nested(model).get(group)
            rows = [] if owner is None else list(_rows(owner, f"{stage}.{group}." if group else f"{stage}."))
            if rows:
                parts.append(f"\n### {stage}\n\n{_summary(model)}\n\n" if not group else f"\n### {stage}\n\n")
                parts.append("| setting | default | meaning | presets |\n|---|---|---|---|\n" + "".join(rows))
    return "".join(parts)


def _nested(model: type[Settings]) -> dict[str, type[Settings]]:
    """Return the groups of settings in a class by their names."""
    found = {name: field.annotation for name, field in model.model_fields.items()}
    return {name: kind for name, kind in found.items() if isinstance(kind, type) and issubclass(kind, Settings)}


def _rows(model: type[Settings], prefix: str) -> Iterator[str]:
    nested = _nested(model)
    for name, field in model.model_fields.items():
        if name not in nested:
            changed = {preset: values[prefix + name] for preset, values in PRESETS.items() if prefix + name in values}
            if "paper-strict" in changed and changed["paper-strict"] == changed.get("paper"):
                del changed["paper-strict"]
            changes = "; ".join(f"{preset}: {_text(value)}" for preset, value in changed.items())
            cells = (f"`{prefix}{name}`", _text(field.default), field.description or "", changes)
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _text(value: Any) -> str:
    match value:
        case None:
            return "not set"
        case "" | ():
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


if __name__ == "__main__":
    Path(__file__).with_name("settings.md").write_text(settings_page(), encoding="utf-8")
