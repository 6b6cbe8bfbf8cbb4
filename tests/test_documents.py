"""Documents must not drift from the code: links, settings, options, columns and weights that they name."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import typer.main

from scopemap import __version__
from scopemap.cli import app
from scopemap.config import PRESETS, setting_names
from scopemap.io.opening import DATASETS
from scopemap.io.weights import REGISTRY
from scopemap.reconstruction import _COLUMNS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])
GROUPS = {name.split(".")[0] for name in setting_names() if "." in name}


def _text(name: str) -> str:
    return (ROOT / name).read_text()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", document.read_text())
    missing = [t for t in targets if not t.startswith("http") and not (document.parent / t).exists()]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_settings_that_are_named_exist(document: Path) -> None:
    named = re.findall(rf"(?<![\w/.])((?:{'|'.join(sorted(GROUPS))})(?:\.[a-z_]+)+)(?![\w(/])", document.read_text())
    files = {f"{group}.{ending}" for group in GROUPS for ending in ("py", "json", "png", "toml")}
    assert set(named) - files <= set(setting_names())


def test_the_readme_names_options_and_commands_that_exist() -> None:
    command = typer.main.get_command(app)
    known = {option for sub in command.commands.values() for param in sub.params for option in param.opts}  # type: ignore[attr-defined]
    lines = [line for line in _text("README.md").splitlines() if "scopemap " in line or line.startswith("|")]
    used = {option for line in lines for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", line)}
    assert "--out" in used
    assert used <= known
    named = set(re.findall(r"(?:`|^ {4}|&& )scopemap ([a-z]+)", _text("README.md"), flags=re.MULTILINE))
    assert named == set(command.commands)  # type: ignore[attr-defined]


def test_the_readme_names_every_preset_and_all_weights() -> None:
    for name in (*PRESETS, *REGISTRY):
        assert f"`{name}`" in _text("README.md").replace("--preset ", "")


def test_reproducing_names_plans_and_weights_that_exist() -> None:
    text = _text("docs/reproduce.md")
    plans = {path.stem for path in (ROOT / "src/scopemap/benchmark/plans").glob("*.toml")}
    assert (
        {"scared", "scared-c", "scared-ablations", "hamlyn"}
        <= set(re.findall(r"scopemap bench ([\w-]+)", text))
        <= plans
    )
    assert set(re.findall(r"^\| `([\w-]+)` \| \d+ \|", text, flags=re.MULTILINE)) <= set(REGISTRY)
    listed = text.split("**By hand**")[1].split("## 4.")[0]
    places = {entry.place for entry in REGISTRY.values() if entry.source != "hand"} - {REGISTRY["raft-small"].place}
    assert all(place in listed for place in places)
    strict = PRESETS["paper-strict"]["depth.model"]
    assert strict in text
    assert strict.replace("/", "--") in text


def test_the_columns_of_frames_csv_are_documented() -> None:
    table = _text("docs/formats.md").split("### frames.csv")[1].split("## What goes in")[0]
    assert re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE) == list(_COLUMNS)


def test_every_data_set_is_documented() -> None:
    layouts, origins = _text("docs/datasets.md").split("## Where they come from")
    origins, measuring = origins.split("## Running and measuring")
    rows = [set(re.findall(r"^\| `([\w-]+)`", part, flags=re.MULTILINE)) for part in (layouts, origins)]
    containers = {"rosbag", "dicom", "video", "images"}
    assert rows == [set(DATASETS), set(DATASETS) - containers]
    assert set(DATASETS) - containers <= set(re.findall(r"`([\w-]+)`", measuring))


def test_versions_agree() -> None:
    assert tomllib.loads(_text("pyproject.toml"))["project"]["version"] == __version__
    assert f"## [{__version__}]" in _text("CHANGELOG.md")
    assert f"version: {__version__}" in _text("CITATION.cff")


def test_constraints_fit_the_requirements() -> None:
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+)$", _text("constraints.txt"), flags=re.MULTILINE))
    canonical = {name.lower().replace("_", "-"): version for name, version in pinned.items()}
    project = tomllib.loads(_text("pyproject.toml"))["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + [one for extra in extras.values() for one in extra if "scopemap[" not in one]
    names = [re.split(r"[=<>\[; ]", requirement)[0].lower() for requirement in wanted]
    assert set(names) <= set(canonical)
    for requirement in wanted:
        name, _, exact = requirement.partition("==")
        assert not exact or canonical[name] == exact
    assert "://" not in _text("constraints.txt")
