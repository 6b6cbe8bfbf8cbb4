"""Settings: precedence, methods, refusals, the way through a file and back, and that each of them is read."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scopemap.engine.config
from docs.settings_page import settings_page
from scopemap.engine.config import PRESETS, Config, MappingSettings, TrackingSettings, setting_names
from scopemap.engine.config.config import REMOVED
from scopemap.engine.config.settings import StageSettings
from scopemap.engine.errors import SettingsError
from scopemap.result.result import Result
from tests.support.places import ROOT

SOURCE = Path(scopemap.engine.config.__file__).parents[2]
STAGES = {name: part for name, part in Config() if isinstance(part, StageSettings)}
# What holds settings, or constants, where they are read; or an object named as their group is.
OWNERS = ("settings", "advanced", "paper", "constants")
# Where the settings of a group are read. A package's own `settings` object counts only in that package.
READERS = {
    "run": ["runner/memory.py"],
    "input": ["input/**/*.py", "runner/*.py"],
    "mask": ["input/mask_files.py", "engine/masking/*.py"],
    "depth": ["engine/depth/*.py", "input/depth_files.py", "runner/*.py", "engine/preprocessing.py"],
    "mapis": ["engine/depth/*.py", "engine/preprocessing.py", "engine/odometry.py"],
    "networks": ["runner/estimators.py"],
    "tracking": ["engine/tracking/*.py", "runner/estimators.py", "engine/preprocessing.py"],
    "smoothing": ["engine/tracking/smoothing.py"],
    "mapping": ["engine/mapping/*.py", "engine/finishing.py", "engine/pipeline.py"],
    "fusion": ["engine/fusion/*.py", "engine/finishing.py", "engine/pipeline.py"],
}


def _write(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "settings.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_precedence_is_defaults_preset_file_single_settings(tmp_path: Path) -> None:
    file = _write(tmp_path, "[tracking]\nkeyframe_every = 7\n[smoothing]\nmethod = 'none'\n")
    assert Config.load() == Config()
    assert (Config().tracking.keyframe_every, Config.load("paper").tracking.keyframe_every) == (10, 2)
    loaded = Config.load("paper", file)
    assert (loaded.tracking.keyframe_every, loaded.smoothing.method, loaded.preset) == (7, "none", "paper")
    assert Config.load("paper", file, {"tracking.keyframe_every": "3"}).tracking.keyframe_every == 3


def test_nothing_is_adjusted_of_a_camera_at_rest(tmp_path: Path) -> None:
    for other in ({}, {"mapping.method": "full"}, {"mapping.local_window": 7}, {"preset": "realtime"}):
        config = Config.load(settings=other | {"tracking.camera_at_rest": "true"})
        assert config.mapping == MappingSettings(method="none")
        assert not config.mapping.adjusts
        assert Config.load(file=_write(tmp_path, config.toml())) == config
    assert Config.load(settings={"tracking.camera_at_rest": False}).mapping == MappingSettings()
    assert Config(tracking=TrackingSettings(camera_at_rest=True)).mapping.method == "none"
    with pytest.raises(SettingsError, match="keyframe_every"):
        Config.load(settings={"tracking.camera_at_rest": True, "tracking.keyframe_every": 0})


def test_the_preset_is_the_command_lines_before_the_files(tmp_path: Path) -> None:
    file = _write(tmp_path, 'preset = "paper"\n')
    assert Config.load(file=file) == Config.load(settings={"preset": "paper"}) == Config.load("paper")
    assert Config.load("realtime", file) == Config.load("default", file, {"preset": "realtime"})
    with pytest.raises(SettingsError, match="unknown preset 'fast': choose one of default, paper, paper-strict, realt"):
        Config.load(file=_write(tmp_path, 'preset = "fast"\n'))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_runs_file_repeats_the_run_without_naming_its_preset(preset: str, tmp_path: Path) -> None:
    changed = {"tracking.solver": "gauss-newton", "input.redact": [[1, 4, 5, 6]]}
    config = Config.load(preset, settings=changed)  # type: ignore[arg-type]
    assert Config.load(file=_write(tmp_path, config.toml())) == config
    assert (config.tracking.solver, config.input.redact) == ("gauss-newton", ((1, 4, 5, 6),))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_file_without_advanced_settings_has_those_of_its_methods(preset: str, tmp_path: Path) -> None:
    """As runs wrote it when these were no settings."""
    config = Config.load(preset)  # type: ignore[arg-type]
    names = {f"{stage}.{name}" for stage, part in STAGES.items() for name in part.sources()}
    text = "".join(line for line in config.toml().splitlines(keepends=True) if line.split(" ")[0] not in names)
    assert "tracking.huber" not in text
    assert Config.load(file=_write(tmp_path, text)) == config


@settings(max_examples=25, deadline=None)
@given(
    voxel_mm=st.floats(0.01, 1000),
    near_far=st.none() | st.tuples(st.floats(1, 9), st.floats(10, 99)),
    text=st.text(),
)
def test_any_values_go_through_a_file(
    tmp_path_factory: pytest.TempPathFactory, voxel_mm: float, near_far: tuple[float, float] | None, text: str
) -> None:
    config = Config.load(settings={"fusion.voxel_mm": voxel_mm, "depth.near_far_mm": near_far, "depth.model": text})
    assert Config.load(file=_write(tmp_path_factory.mktemp("settings"), config.toml())) == config
    assert config.depth.model == text


@pytest.mark.parametrize(
    ("stage", "method"), [(stage, name) for stage, part in STAGES.items() for name in part.METHODS]
)
def test_each_method_changes_advanced_settings_to_values_of_their_types(stage: str, method: str) -> None:
    default, chosen = STAGES[stage], getattr(Config.load(settings={f"{stage}.method": method}), stage)
    before, after = default.model_dump(exclude={"method"}), chosen.model_dump(exclude={"method"})
    changed = {name for name in before if after[name] != before[name]}
    assert changed == set(default.METHODS[method]) <= set(default.sources())
    assert chosen.has(method)
    assert all(type(after[name]) is type(before[name]) for name in changed)


def test_each_method_is_named_by_a_preset_or_a_document() -> None:
    """What only a benchmark's plan needs is a setting there."""
    documents = [file.read_text(encoding="utf-8") for file in ROOT.glob("docs/*.md") if file.name != "settings.md"]
    named = set(re.findall(r"([a-z]+)\.method ?= ?([a-z+-]+)", "\n".join(documents)))
    for values in PRESETS.values():
        named |= {(name.removesuffix(".method"), str(method)) for name, method in values.items()}
    used = {(stage, method) for stage, joined in named for method in joined.split("+")}
    defaults = {(stage, type(part).model_fields["method"].default) for stage, part in STAGES.items()}
    assert {(stage, method) for stage, part in STAGES.items() for method in part.METHODS} - used <= defaults


def test_of_joined_methods_the_later_one_wins() -> None:
    both = Config.load("paper", settings={"tracking.method": "paper+realtime+least-squares"}).tracking
    assert (both.fast, both.photometric, both.huber) == (True, "paper", 1e6)
    for joined, checks in (("no-pose-checks+paper", "poses"), ("paper+no-pose-checks", "none")):
        assert Config.load(settings={"tracking.method": joined}).tracking.checks == checks


def test_an_advanced_setting_counts_before_a_method_unless_a_later_source_names_another(tmp_path: Path) -> None:
    single = {"tracking.huber": "2", "tracking.method": "paper"}
    assert Config.load(settings=single).tracking == TrackingSettings(method="paper", huber=2.0)
    assert Config.load("paper", settings={"tracking.huber": 2}).tracking.photometric == "paper"
    file = _write(tmp_path, Config.load(settings=single | {"tracking.keyframe_every": 4}).toml())
    assert Config.load(file=file, settings={"tracking.levels": 4}).tracking.huber == 2.0
    other = Config.load(file=file, settings={"tracking.method": "realtime"}).tracking
    assert other == TrackingSettings(method="realtime", keyframe_every=4)
    assert Config.load(file=file, settings={"mapping.method": "none"}).tracking.huber == 2.0


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        (
            "tracking.keyframes_every",
            1,
            "unknown setting 'tracking.keyframes_every': did you mean 'tracking.keyframe_ev",
        ),
        ("tracking.constants", {}, "unknown setting 'tracking.constants': did you mean 'tracking"),
        ("fusion.voxel", 1, "did you mean 'fusion.voxel_mm'"),
        ("qqqq", 1, "unknown setting 'qqqq': choose from preset, run"),
        ("tracking.method", "papper", "'tracking.method': unknown method 'papper': did you mean 'paper'"),
        ("tracking.method", "paper+", "unknown method '': choose from scopemap, paper"),
        ("tracking.method", 7, "'tracking.method': Input should be a valid string"),
        ("tracking.advanced.huber", 2, "unknown setting 'tracking.advanced.huber': did you mean 'tracking"),
        ("tracking.hubert", 2, "did you mean 'tracking.huber'"),
        ("tracking.huber", 0, "greater than 0"),
        ("tracking.finest_level", 4, "less than or equal to 3"),
        ("tracking.solver", "lbfgs", "'dogleg', 'gauss-newton'"),
        ("input.redact", [[1, 2, 3]], "Field required"),
        ("input.redact", [[1, 2, 3, 0]], "greater than or equal to 1"),
        ("tracking.keyframe_every", 0, "greater than or equal to 1"),
        ("tracking.keyframe_every", "wide", "valid integer"),
        ("fusion.voxel_mm", float("nan"), "'fusion.voxel_mm'.*finite number"),
        ("fusion.voxel_mm", "inf", "'fusion.voxel_mm'.*finite number"),
        ("fusion.holes", "some", "'watertight'"),
        ("depth.near_far_mm", [1, 2, 3], "at most 2"),
    ],
)
def test_an_unknown_key_or_an_impossible_value_is_refused(key: str, value: object, what: str) -> None:
    with pytest.raises(SettingsError, match=what) as caught:
        Config.load(settings={key: value, "run.memory_mb": 5})
    assert ";" not in str(caught.value)


def test_several_faults_are_reported_at_once() -> None:
    with pytest.raises(SettingsError, match=r"keyframe_every.*got -1.*fusion\.voxel_mm"):
        Config.load(settings={"tracking.keyframe_every": -1, "fusion.voxel_mm": 0})


@pytest.mark.parametrize(
    "content",
    [
        *(b"[odometry\nhuber=1", b"\xff\xfe\x00", b"a = " + b"[" * 100_000, b"a = " + b"{a=" * 2_000),
        *(b"[" + b"a." * 5_000 + b"b]\nx = 1", b"tracking.keyframe_every = " + b"9" * 5000),
    ],
)
def test_an_unreadable_file_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "broken.toml"
    file.write_bytes(content)
    with pytest.raises(SettingsError, match=r"cannot read the settings in .*broken\.toml"):
        Config.load(file=file)
    with pytest.raises(SettingsError, match="absent"):
        Config.load(file=tmp_path / "absent.toml")


def test_a_result_of_another_version_keeps_the_settings_that_are_still_there(tmp_path: Path) -> None:
    config = Config.load("paper", settings={"tracking.huber": 2, "fusion.voxel_mm": 0.5})
    file = _write(tmp_path, config.toml() + "tracking.lamp_gamma = 0.35\nmapping.moving_tissue = true\n")
    with pytest.raises(SettingsError, match=r"tracking\.lamp_gamma \(removed, use tracking\.photometric\)"):
        Config.load(file=file)
    file.rename(tmp_path / "config.toml")
    ignored = (
        r"ignores settings of another version in .*config\.toml \(2\): mapping\.moving_tissue, tracking\.lamp_gamma$"
    )
    with pytest.warns(UserWarning, match=ignored):
        assert Result(tmp_path).config == config


def test_a_range_replaces_the_anchor_of_a_preset(tmp_path: Path) -> None:
    """`--preset paper --near-far 10:80` must not be ignored: only the same source can name another anchor."""
    near_far = {"depth.near_far_mm": (10, 80)}
    assert Config.load("paper").depth.anchor == "depth-pro"
    assert Config.load("paper", settings=near_far).depth.anchor == "near-far"
    assert Config.load("paper", settings=near_far | {"depth.anchor": "depth-pro"}).depth.anchor == "depth-pro"
    assert Config.load(settings=near_far).depth.anchor == "auto"
    anchor = _write(tmp_path, '[depth]\nanchor = "shading"\n')
    assert Config.load("paper", anchor).depth.anchor == "shading"
    assert Config.load("paper", anchor, near_far).depth.anchor == "near-far"


def test_another_network_does_not_get_the_weights_of_the_preset() -> None:
    v1 = Config.load("paper-strict").depth.model
    assert Config.load("paper-strict", settings={"depth.backend": "scopenet"}).depth.model == ""
    assert Config.load("paper-strict", settings={"depth.backend": "depth-anything"}).depth.model == v1 != ""
    own = {"depth.backend": "depth-pro", "depth.model": "mine"}
    assert Config.load("paper-strict", settings=own).depth.model == "mine"


def test_the_page_of_settings_is_the_generated_one() -> None:
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == settings_page(), "docs/settings.md is out of date: python docs/settings_page.py writes it"


def test_each_setting_is_read() -> None:
    named = {tuple(name.split(".")) for name in setting_names() if "." in name}
    # What a method is, is read where it chooses settings.
    named -= {(stage, "method") for stage in STAGES if stage != "smoothing"}
    assert {group for group, _ in named} == set(READERS)
    # Read by a property of the settings' own class, which gives the choice a meaning.
    in_words = {
        key for file in (SOURCE / "engine/config").glob("*.py") for owner, key in _read_in(file) if owner == "self"
    }
    for group, name in named:
        files = [file for pattern in READERS[group] for file in SOURCE.glob(pattern)]
        read = {key for file in files for owner, key in _read_in(file) if owner in (*OWNERS, group)} | in_words
        assert name in read, f"{group}.{name} is read nowhere in {READERS[group]}"


@cache
def _read_in(file: Path) -> set[tuple[str, str]]:
    """Return (owner, key) of every `<owner>.key` in the file, whatever `<owner>` hangs on."""
    attributes = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Attribute)]
    owners = [getattr(node.value, "attr", getattr(node.value, "id", "")) for node in attributes]
    return {(owner.strip("_"), node.attr) for owner, node in zip(owners, attributes, strict=True)}


def test_the_file_of_an_earlier_version_is_refused_once_by_what_became_of_its_settings(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    gone = ("mask.highlights = true", "smoothing.alpha = 0.3", "mapping.moving_tissue = true", "fusion.foo = 1")
    file.write_text(Config().toml() + "\n".join(gone) + "\n")
    with pytest.raises(SettingsError) as refused:
        Config.load(file=file)
    assert str(refused.value) == (
        f"{file} is of another version of scopemap. Delete the lines of these settings: fusion.foo (unknown), "
        "mapping.moving_tissue (removed, nothing takes its place), mask.highlights (removed, use "
        "mask.method=no-highlights), smoothing.alpha (removed, nothing takes its place)"
    )
    with pytest.raises(SettingsError, match=r"'tracking\.channels': removed, use tracking\.photometric"):
        Config.load(settings={"tracking.channels": 3})


def test_what_replaces_a_removed_setting_is_one() -> None:
    assert not REMOVED.keys() & set(setting_names())
    for place in filter(None, REMOVED.values()):
        name, _, value = place.partition("=")
        Config.load(settings={name: value} if value else {name: getattr(*_parent(name))})


def _parent(name: str) -> tuple[object, str]:
    group, _, own = name.partition(".")
    return getattr(Config(), group), own


def test_the_changelog_names_every_removed_setting() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    removed = text.partition("### Removed")[2].partition("\n### ")[0]
    assert [name for name in REMOVED if f"`{name}`" not in removed] == []
