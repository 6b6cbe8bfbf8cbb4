"""Documents must not drift from the code: links, settings, options, columns and weights that they name."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest
import typer.main
import yaml

import scopemap
import scopemap_bench
from docs.api_page import api_page
from docs.camera_programs import PAGE, programs_page
from docs.method_picture import BANDS, FILE, LETTERS, lines_of, method_picture
from scopemap import __version__
from scopemap.cli.app import app
from scopemap.engine.config import PRESETS, Config, setting_names
from scopemap.engine.models.weights import REGISTRY
from scopemap.input.opening import readers
from scopemap.result.frame_table import COLUMNS
from tests.support.places import ROOT

DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "bench").glob("*.md")])
GROUPS = {name.split(".")[0] for name in setting_names() if "." in name}


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8"))
    missing = [t for t in targets if not t.startswith("http") and not (document.parent / t).exists()]
    assert missing == []


@pytest.mark.parametrize(
    "document", [one for one in DOCUMENTS if one.name != "CHANGELOG.md"], ids=lambda path: path.name
)
def test_settings_that_are_named_exist(document: Path) -> None:
    named = re.findall(
        rf"(?<![\w/.])((?:{'|'.join(sorted(GROUPS))})(?:\.[a-z_]+)+)(?![\w(/])", document.read_text(encoding="utf-8")
    )
    files = {f"{group}.{ending}" for group in GROUPS for ending in ("py", "json", "png", "toml", "md")}
    assert set(named) - files <= set(setting_names())


def test_the_readme_names_every_command() -> None:
    command = typer.main.get_command(app)
    named = set(re.findall(r"(?:`|^ {4}|&& )scopemap ([a-z-]+)", _text("README.md"), flags=re.MULTILINE))
    assert named == set(command.commands)  # type: ignore[attr-defined]


def test_every_page_is_in_the_navigation() -> None:
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    navigation = _text("mkdocs.yml").split("\nnav:")[1]
    assert sorted(re.findall(r"[\w./-]+\.md", navigation)) == sorted(pages)


def test_the_page_of_the_interface_is_the_generated_one_and_has_every_public_name() -> None:
    assert _text("docs/api.md") == api_page(), "docs/api.md is out of date: python docs/api_page.py writes it"
    shown = re.findall(r"^### (\w+)$", _text("docs/api.md"), flags=re.MULTILINE)
    assert sorted(shown) == sorted([*scopemap._HOMES, *scopemap_bench.__all__])
    assert set(scopemap.__all__) == set(scopemap._HOMES) | {"__version__"}


def test_the_list_of_programs_is_that_of_their_table() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == programs_page(page), "docs/calibrate.md is out of date: python docs/camera_programs.py writes it"


def test_the_diagram_of_the_method_is_the_drawn_one_and_fits_its_boxes() -> None:
    """A setting of a preset without words in the diagram, or words that are no longer true, fail here."""
    drawn = FILE.read_text(encoding="utf-8")
    assert drawn == method_picture(), f"{FILE.name} is out of date: python docs/method_picture.py draws it"
    paper, default = Config.load("paper-strict"), Config.load("default")
    for box in (box for boxes in BANDS.values() for box in boxes):
        lines = [text for text, _ in lines_of(box, box.words(paper), box.words(default))]
        assert len(box.name) <= LETTERS
        assert max(map(len, lines)) <= LETTERS, (box.name, lines)
        assert len(lines) <= 4 * box.rows - 1 + (box.rows > 1), (box.name, lines)
    shown = {element.text for element in ElementTree.fromstring(drawn).iter() if element.tag.endswith("text")}
    assert {box.name for boxes in BANDS.values() for box in boxes} <= shown
    named = [page for page in ("method.md", "reproduce.md") if f"pictures/{FILE.name}" in _text(f"docs/{page}")]
    assert named == ["method.md", "reproduce.md"]


def test_every_preset_and_all_weights_are_documented() -> None:
    presets, weights = (
        re.findall(r"^\| (`[a-z-]+`.*?) \|", table, flags=re.MULTILINE)
        for table in (_text("docs/presets.md"), _text("docs/depth.md").split("## Weights")[1])
    )
    assert set(re.findall(r"`([a-z-]+)`", " ".join(presets))) == set(PRESETS)
    assert set(re.findall(r"`([a-z-]+)`", " ".join(weights))) == set(REGISTRY)


def test_reproducing_names_plans_and_weights_that_exist() -> None:
    text = _text("docs/reproduce.md")
    plans = {path.stem for path in (ROOT / "bench/src/scopemap_bench/plans").glob("*.toml")}
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
    assert re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE) == list(COLUMNS)


def test_every_data_set_is_documented() -> None:
    layouts, origins = _text("docs/datasets.md").split("## Where they come from")
    origins, measuring = origins.split("## Running and measuring")
    rows = [set(re.findall(r"^\| `([\w-]+)`", part, flags=re.MULTILINE)) for part in (layouts, origins)]
    containers = {"rosbag", "dicom", "video", "images"}
    assert rows == [set(readers()), set(readers()) - containers]
    assert set(readers()) - containers <= set(re.findall(r"`([\w-]+)`", measuring))


def test_versions_and_licences_agree() -> None:
    project, citation = tomllib.loads(_text("pyproject.toml"))["project"], yaml.safe_load(_text("CITATION.cff"))
    assert project["version"] == __version__ == str(citation["version"])
    assert f"## [{__version__}]" in _text("CHANGELOG.md")
    assert citation["license"] == project["license"]


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


def test_the_words_of_the_makefile_are_those_that_contributing_shows() -> None:
    words = re.findall(r"^(\w+):", _text("Makefile"), flags=re.MULTILINE)
    assert re.findall(r"^    make (\w+)", _text("CONTRIBUTING.md"), flags=re.MULTILINE) == words
    scripts = re.findall(r"python (\S+\.py)", _text("Makefile"))
    assert [name for name in scripts if not (ROOT / name).is_file()] == []


def test_the_container_is_what_the_readme_says() -> None:
    lines = _text("Containerfile").splitlines()
    copied = {source for line in lines if line.startswith("COPY ") for source in line.split()[1:-1]}
    assert {"constraints.txt", "pyproject.toml", "src"} <= copied
    assert [source for source in copied if not (ROOT / source).exists()] == []
    kept = {line.removeprefix("!") for line in _text(".dockerignore").splitlines() if line.startswith("!")}
    assert {source.split("/")[0] for source in copied} == kept
    assert list((ROOT / "containers").rglob("Containerfile*")) == []
    first = next(line.strip() for line in _text("README.md").splitlines() if line.startswith("    pip install"))
    assert f"RUN {first.partition(' && ')[0]}" in lines
    user = next(line for line in lines if line.startswith("USER "))
    assert user.split()[1].split(":")[0] not in ("0", "root")
    last = [number for number, line in enumerate(lines) if line.startswith(("RUN ", "FROM "))][-1]
    assert lines[last].split() == ["FROM", "installed"]
    assert lines.index(user) > last
    stages = re.findall(r"--target (\w+)", _text("docs/climb.md"))
    assert stages
    assert {f"FROM installed AS {stage}" for stage in stages} <= set(lines)


def test_workflows_name_files_that_exist_and_store_no_secret() -> None:
    for file in (ROOT / ".github/workflows").glob("*.yml"):
        text = file.read_text(encoding="utf-8")
        assert {"on", "jobs", "permissions"} <= {"on" if key is True else key for key in yaml.safe_load(text)}
        assert "secrets." not in text
        assert [name for name in re.findall(r"tests/[\w/]+\.py|\.ci/\w+", text) if not (ROOT / name).exists()] == []


def test_every_extra_is_documented() -> None:
    table = _text("docs/install.md").split("## Where things")[0]
    rows = re.findall(r"^\| ((?:`[a-z]+`(?:, )?)+) \|", table, flags=re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([a-z]+)`", row)}
    assert named == set(tomllib.loads(_text("pyproject.toml"))["project"]["optional-dependencies"])


@pytest.mark.parametrize("name", ["how-it-works", "method", "extend"])
def test_source_files_that_are_named_exist(name: str) -> None:
    named = re.findall(r"`((?:[\w-]+/)*[\w-]+\.py)`", _text(f"docs/{name}.md"))
    assert named
    folders = ("", "src/scopemap", "bench/src/scopemap_bench", "src/scopemap/engine/depth/scopenet", "training")
    places = [ROOT / folder for folder in folders]
    assert [one for one in named if "NAME" not in one and not any((place / one).exists() for place in places)] == []


def test_a_wheel_holds_every_file_of_the_package() -> None:
    patterns = tomllib.loads(_text("pyproject.toml"))["tool"]["setuptools"]["package-data"]["scopemap"]
    package = ROOT / "src/scopemap"
    files = [path.relative_to(package) for path in package.rglob("*") if path.is_file() and path.suffix != ".py"]
    files = [path for path in files if "__pycache__" not in path.parts]
    assert files
    assert [str(path) for path in files if not any(path.match(pattern) for pattern in patterns)] == []
    assert [str(path.parent) for path in package.rglob("*.py") if not (path.parent / "__init__.py").is_file()] == []
