"""Settings: precedence, refusals, the way through a file and back, and that none of them is read by nobody."""

from __future__ import annotations

import ast
import tomllib
from operator import attrgetter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scopemap.config
from docs.settings_page import settings_page
from scopemap.config import PRESETS, Config, setting_names
from scopemap.errors import SettingsError

SOURCE = Path(scopemap.config.__file__).parents[1]
ROOT = Path(__file__).resolve().parents[1]
# Where the settings of a group are read. A room's own `settings` object counts only in that room.
READERS = {
    "run": ["runner/memory.py"],
    "input": ["io/*.py", "cameras/**/*.py", "calibration/**/*.py", "runner/*.py"],
    "mask": ["masking/*.py"],
    "depth": ["depth/*.py"],
    "mapis": ["depth/*.py", "preprocessing.py", "odometry.py"],
    "networks": ["estimators.py"],
    "tracking": ["tracking/*.py", "estimators.py"],
    "smoothing": ["tracking/smoothing.py"],
    "mapping": ["mapping/*.py", "estimators.py", "pipeline.py", "runner/*.py"],
    "fusion": ["fusion/*.py", "pipeline.py", "runner/run.py"],
}


def _write(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "settings.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_precedence(tmp_path: Path) -> None:
    file = _write(tmp_path, "[tracking]\nadvanced.huber = 2.5\nkeyframe_every = 7\n[smoothing]\nmethod = 'none'\n")
    names = {"tracking.advanced.huber": 3.5}
    assert Config.load().tracking.keyframe_every == 10
    assert Config.load("paper").tracking.keyframe_every == 2
    assert Config.load("paper", file).tracking.keyframe_every == 7
    assert Config.load("paper", file).smoothing.method == "none"
    assert Config.load("paper", file).tracking.advanced.huber == 2.5
    loaded = Config.load("paper", file, names)
    assert (loaded.tracking.advanced.huber, loaded.tracking.keyframe_every, loaded.mapis.paper.order) == (
        3.5,
        7,
        "refine-first",
    )
    assert loaded.preset == "paper"


def test_defaults_are_the_default_preset() -> None:
    assert Config.load() == Config()


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_hold_and_name_only_what_exists(preset: str) -> None:
    config = Config.load(preset)  # type: ignore[arg-type]
    assert set(PRESETS[preset]) <= set(setting_names())
    for dotted, value in PRESETS[preset].items():
        assert attrgetter(dotted)(config) == value


def test_every_preset_changes_something_but_the_default() -> None:
    for preset, changes in PRESETS.items():
        same = [key for key, value in changes.items() if attrgetter(key)(Config()) == value]
        assert (preset == "default") == (not changes)
        assert len(same) < max(len(changes), 1)


@pytest.mark.parametrize(
    ("wrong", "near"),
    [
        ("tracking.keyframes_every", "tracking.keyframe_every"),
        ("fusion.voxel", "fusion.voxel_mm"),
        ("fusion.advanced.voxel_mm", "fusion.voxel_mm"),
        ("fusion.paper.min_weight", "fusion.advanced.min_weight"),
        ("trackin", "tracking"),
    ],
)
def test_an_unknown_key_names_the_nearest(wrong: str, near: str) -> None:
    with pytest.raises(SettingsError, match=rf"unknown setting '{wrong}': did you mean '{near}"):
        Config.load(settings={wrong: 1})


def test_an_unknown_key_in_a_file_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"did you mean 'mapis\.paper\.tau'"):
        Config.load(file=_write(tmp_path, "[mapis]\ntaw = 0.2\n"))


def test_an_unknown_key_like_nothing_is_still_refused() -> None:
    with pytest.raises(SettingsError, match=r"unknown setting 'qqqq'$"):
        Config.load(settings={"qqqq": 1})


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        ("tracking.advanced.huber", 0, "greater than 0"),
        ("tracking.advanced.huber", "wide", "valid number"),
        ("mapis.paper.blend", "mixed", "'exponential'"),
        ("mask.advanced.dark_level", 300, "less than or equal to 255"),
        ("depth.near_far_mm", [1, 2, 3], "at most 2"),
        ("smoothing.alpha", 0.9, "alpha \\+ beta \\+ gamma must be 1, got 1.3"),
    ],
)
def test_an_impossible_value_is_refused_by_name(key: str, value: object, what: str) -> None:
    with pytest.raises(SettingsError, match=what) as caught:
        Config.load(settings={key: value})
    assert key.split(".")[0] in str(caught.value)


def test_several_faults_are_told_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        Config.load(settings={"tracking.advanced.huber": -1, "fusion.voxel_mm": 0})
    assert all(key in str(caught.value) for key in ("tracking.advanced.huber", "fusion.voxel_mm", "got -1"))


def test_smoothing_weights_that_sum_to_one_are_taken() -> None:
    chosen = Config.load(settings={"smoothing.alpha": 0.5, "smoothing.beta": 0.25, "smoothing.gamma": 0.25}).smoothing
    assert (chosen.alpha, chosen.beta, chosen.gamma) == (0.5, 0.25, 0.25)


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
    both = _write(tmp_path, '[depth]\nanchor = "shading"\nnear_far_mm = [10, 80]\n')
    assert Config.load("paper", both).depth.anchor == "shading"


def test_another_network_does_not_get_the_weights_of_the_preset() -> None:
    v1 = Config.load("paper-strict").depth.model
    assert Config.load("paper-strict", settings={"depth.backend": "scopenet"}).depth.model == ""
    assert Config.load("paper-strict", settings={"depth.backend": "depth-anything"}).depth.model == v1 != ""
    own = {"depth.backend": "depth-pro", "depth.model": "mine"}
    assert Config.load("paper-strict", settings=own).depth.model == "mine"


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(SettingsError, match="choose one of default, paper, paper-strict, realtime"):
        Config.load("fast")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "content",
    [
        *(b"[odometry\nhuber=1", b"\xff\xfe\x00", b"a = " + b"[" * 100_000, b"a = " + b"{a=" * 20_000),
        *(b"[" + b"a." * 50_000 + b"b]\nx = 1", b"tracking.keyframe_every = " + b"9" * 5000),
    ],
)
def test_an_unreadable_file_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "broken.toml"
    file.write_bytes(content)
    with pytest.raises(SettingsError, match=r"cannot read the settings in .*broken\.toml"):
        Config.load(file=file)
    with pytest.raises(SettingsError, match="absent"):
        Config.load(file=tmp_path / "absent.toml")


def test_values_may_be_text() -> None:
    config = Config.load(
        settings={"tracking.advanced.huber": "2.5", "fusion.enabled": "false", "tracking.advanced.levels": "3"}
    )
    assert (config.tracking.advanced.huber, config.fusion.enabled, config.tracking.advanced.levels) == (2.5, False, 3)


def test_settings_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Config().tracking.advanced.huber = 3.0  # type: ignore[misc]


@pytest.mark.parametrize("preset", PRESETS)
def test_toml_round_trip_of_presets(preset: str, tmp_path: Path) -> None:
    config = Config.load(preset)  # type: ignore[arg-type]
    assert Config.load(preset, _write(tmp_path, config.toml())) == config  # type: ignore[arg-type]


Range = tuple[float, float] | None
texts = st.text(min_size=1)
numbers = st.floats(1e-9, 1e9, allow_nan=False, allow_infinity=False)


@settings(max_examples=25, deadline=None)
@given(numbers, st.booleans(), st.none() | st.tuples(numbers, numbers), texts)
def test_toml_round_trip(huber: float, fused: bool, near_far: Range, folder: str) -> None:
    given = {
        "tracking.advanced.huber": huber,
        "fusion.enabled": fused,
        "depth.near_far_mm": near_far,
        "depth.backend": f"files:{folder}",
    }
    config = Config.load(settings=given)
    tree = tomllib.loads(config.toml())
    assert tree["tracking"]["advanced"]["huber"] == huber
    assert tree["depth"]["backend"] == f"files:{folder}"
    assert Config.model_validate(tree) == config


def test_a_runs_file_repeats_the_run_without_naming_its_preset(tmp_path: Path) -> None:
    config = Config.load("paper", settings={"tracking.advanced.huber": 3.0})
    assert Config.load(file=_write(tmp_path, config.toml())) == config


def test_a_preset_named_in_a_file_is_applied(tmp_path: Path) -> None:
    assert Config.load(file=_write(tmp_path, 'preset = "paper"\n')) == Config.load("paper")


def test_the_preset_is_the_command_lines_before_the_files(tmp_path: Path) -> None:
    file = _write(tmp_path, 'preset = "paper"\n[tracking]\nadvanced.huber = 2.5\n')
    realtime = Config.load("realtime", settings={"tracking.advanced.huber": 2.5})
    assert Config.load(settings={"preset": "paper"}) == Config.load("paper")
    assert Config.load("realtime", file) == realtime
    assert Config.load("default", file, {"preset": "realtime"}) == realtime
    with pytest.raises(SettingsError, match="unknown preset 'fast'"):
        Config.load(file=_write(tmp_path, 'preset = "fast"\n'))


@pytest.mark.parametrize("text", ["Größe \u2028 胃 \U0001f52c", 'a"b\\c\n\t\x00\x7f'])
def test_any_text_goes_through_a_file(text: str, tmp_path: Path) -> None:
    config = Config.load(settings={"depth.model": text})
    (tmp_path / "c.toml").write_text(config.toml(), encoding="utf-8")
    assert Config.load(file=tmp_path / "c.toml") == config


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "nan", "inf"])
@pytest.mark.parametrize("key", ["tracking.advanced.huber", "fusion.voxel_mm"])
def test_what_is_no_number_is_refused(key: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"'{key}'.*finite number"):
        Config.load(settings={key: value})


def test_the_page_of_settings_is_the_generated_one() -> None:
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == settings_page(), "docs/settings.md is out of date: python docs/settings_page.py writes it"
    assert all(f"`{name}`" in page for name in setting_names() if "." in name)


def test_setting_names_are_all_leaves() -> None:
    names = setting_names()
    assert len(names) == len(set(names)) > 50
    assert {name.split(".")[0] for name in names} - {"preset"} == set(READERS)


@pytest.mark.parametrize("name", sorted(name for name in setting_names() if "." in name))
def test_no_setting_is_parsed_and_ignored(name: str) -> None:
    group, *_, key = name.split(".")
    files = [file for pattern in READERS[group] for file in SOURCE.glob(pattern)]
    assert any(_reads(file, group, key) for file in files), f"{name} is read nowhere in {READERS[group]}"


def _reads(file: Path, group: str, key: str) -> bool:
    """Whether `<settings or group>.key` stands in the file, whatever `<...>` hangs on."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Attribute) and node.attr == key:
            owner = node.value
            name = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
            if name.strip("_") in ("settings", "advanced", "paper", group):
                return True
    return False
