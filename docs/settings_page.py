"""The page of settings, docs/settings.md, generated from the settings' classes: `python docs/settings_page.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scopemap.engine.config import PRESETS, Config, Settings
from scopemap.engine.config.settings import StageSettings

_HEAD = """# Settings

Every setting can be set on the command line (`--set tracking.keyframe_every=5`), in a TOML file (`--config FILE`) or by
a preset. The order is defaults < preset < file < command line. A result's `config.toml` holds all settings and is a
valid file. A cell "presets" names what presets change; `paper-strict` changes what `paper` does, too.
[Advanced settings](#advanced-settings) and the [methods](#methods) that choose them are at the end.
`python docs/settings_page.py` writes this page.
"""
_ADVANCED = """
## Advanced settings

The constants of the stages. They are set as the others are: `--set tracking.huber=2`. The last column says where the
default comes from. The paper is [arXiv 2508.11282](https://arxiv.org/abs/2508.11282), which publishes none of its
constants; "by hand" is a value that was chosen without a search that is on record.

| setting | default | meaning | default from |
|---|---|---|---|
"""
_METHODS = """
## Methods

A stage's `method` chooses its advanced settings. Methods can be joined, the later one wins:
`--set tracking.method=paper+least-squares`. An advanced setting that is given itself counts before the method. A method
that comes later (in a file after the preset, on the command line after both) replaces advanced settings that came
earlier. A method that changes none leaves out the part that it names, as the setting's meaning says.

| setting | method | advanced settings that it changes |
|---|---|---|
"""


def settings_page() -> str:
    """Return docs/settings.md: a table per stage, then the advanced settings and the methods of all stages."""
    parts = [_HEAD]
    stages = {name: part for name, part in Config() if isinstance(part, Settings)}
    for stage, part in stages.items():
        meaning = " ".join((type(part).__doc__ or "").split())
        parts.append(f"\n## {stage}\n\n{meaning}\n\n| setting | default | meaning | presets |\n|---|---|---|---|\n")
        usual = part.model_dump(exclude=set(part.sources()))
        parts += [
            _row(*_cells(f"{stage}.{name}", value, part), _presets(f"{stage}.{name}")) for name, value in usual.items()
        ]
    parts.append(_ADVANCED)
    for stage, part in stages.items():
        for name, source in part.sources().items():
            parts.append(_row(*_cells(f"{stage}.{name}", getattr(part, name), part), source))
    parts.append(_METHODS)
    for stage, part in stages.items():
        for method, changes in part.METHODS.items() if isinstance(part, StageSettings) else ():
            changed = ", ".join(f"{name} = {_text(value)}" for name, value in changes.items())
            parts.append(_row(f"`{stage}.method`", method, changed))
    return "".join(parts)


def _cells(name: str, default: Any, stage: Settings) -> tuple[str, str, str]:
    meaning = type(stage).model_fields[name.rpartition(".")[2]].description or ""
    return f"`{name}`", _text(default), meaning


def _presets(name: str) -> str:
    changed = {preset: values[name] for preset, values in PRESETS.items() if name in values}
    if "paper-strict" in changed and changed["paper-strict"] == changed.get("paper"):
        del changed["paper-strict"]
    return "; ".join(f"{preset}: {_text(value)}" for preset, value in changed.items())


def _row(*cells: str) -> str:
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
