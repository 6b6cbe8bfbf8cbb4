"""The page of settings, docs/settings.md, generated from the settings' classes: `python docs/settings_page.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scopemap.engine.config import PRESETS, Config, Settings
from scopemap.engine.config.settings import StageSettings

_HEAD = """# Settings

All settings: on the command line (`--set tracking.keyframe_every=5`), in a TOML file (`--config FILE`) or by a preset.
The order is defaults < preset < file < command line. A result's `config.toml` is such a file. `paper-strict` also
changes what `paper` changes. `python docs/settings_page.py` writes this page.
"""
_METHODS = """
## Methods

A stage's `method` names its constants (described in `src/scopemap/engine/config/`). Methods can be joined, the later
one wins: `--set tracking.method=paper+gauss-newton`.

| setting | method | constants that it changes |
|---|---|---|
"""


def settings_page() -> str:
    """Return docs/settings.md: a table per stage, then the methods of all stages."""
    parts = [_HEAD]
    stages = {name: part for name, part in Config() if isinstance(part, Settings)}
    for stage, part in stages.items():
        meaning = " ".join((type(part).__doc__ or "").split())
        parts.append(f"\n## {stage}\n\n{meaning}\n\n| setting | default | meaning | presets |\n|---|---|---|---|\n")
        parts += [_row(f"{stage}.{name}", value, type(part)) for name, value in part.model_dump().items()]
    parts.append(_METHODS)
    for stage, part in stages.items():
        for method, changes in part.METHODS.items() if isinstance(part, StageSettings) else ():
            changed = ", ".join(f"{name} = {_text(value)}" for name, value in changes.items())
            parts.append(f"| `{stage}.method` | {method} | {changed} |\n")
    return "".join(parts)


def _row(name: str, default: Any, stage: type[Settings]) -> str:
    meaning = stage.model_fields[name.rpartition(".")[2]].description or ""
    changed = {preset: values[name] for preset, values in PRESETS.items() if name in values}
    if "paper-strict" in changed and changed["paper-strict"] == changed.get("paper"):
        del changed["paper-strict"]
    changes = "; ".join(f"{preset}: {_text(value)}" for preset, value in changed.items())
    cells = (f"`{name}`", _text(default), meaning, changes)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


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


if __name__ == "__main__":
    Path(__file__).with_name("settings.md").write_text(settings_page(), encoding="utf-8")
