"""Benchmark plans: read, refused, expanded into rows; those that come along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, SettingsError
from scopemap_bench.entry import Entry, entries_of
from scopemap_bench.methods.method import create_method
from scopemap_bench.plan import Plan, found_sequences, read_plan, shipped_plans
from scopemap_bench.runner import run_plan
from tests.support.sample_trajectories import write_c3vd

SMALL = """
title = "small"
seeds = [0, 3]
settings = { "fusion.enabled" = false }

[[sequence]]
path = "clips/c*"
depth = "files:depths"
near_far_mm = [10, 90]

[[sequence]]
name = "tube"
phantom = { scene = "tube", frames = 5, seed = 4, width = 64, height = 48, events = "black:2-3" }
depth = "true"

[[method]]
name = "ours"

[[method]]
name = "theirs"
use = "import"
files = "theirs/{sequence}-{seed}.txt"
"""


def written(folder: Path, text: str = SMALL) -> Path:
    file = folder / "plan.toml"
    file.write_text(text)
    return file


def rows(folder: Path) -> list[Entry]:
    return rows_of(SMALL, folder)


def rows_of(text: str, folder: Path) -> list[Entry]:
    data = folder / "data"
    for name in ("c10", "c2"):
        (data / "clips" / name).mkdir(parents=True)
    plan = read_plan(written(folder, text))
    sequences, missing = found_sequences(plan, data)
    assert missing == []
    return list(entries_of(plan, sequences, data, folder / "out"))


def test_a_pattern_finds_clips_and_seeds_repeat_only_what_depends_on_them(tmp_path: Path) -> None:
    found = [(row.sequence.name, row.method.name, row.seed) for row in rows(tmp_path)]
    clips = [("clips/c10", "ours", 0), ("clips/c10", "theirs", 0), ("clips/c10", "theirs", 3)]
    clips += [("clips/c2", *rest) for _, *rest in clips]
    tube = [("tube", method, seed) for seed in (0, 3) for method in ("ours", "theirs")]
    assert sorted(found) == sorted(clips + tube)


def test_every_row_has_its_own_folder_and_fingerprint(tmp_path: Path) -> None:
    found = rows(tmp_path)
    assert len({row.folder for row in found}) == len({row.key for row in found}) == len(found)
    assert all(row.folder.is_relative_to(tmp_path / "out" / "runs") for row in found)
    again = found[0].model_copy(update={"data": tmp_path / "elsewhere", "out": tmp_path / "other"})
    assert again.key == found[0].key
    assert found[0].model_copy(update={"settings": {"fusion.enabled": True}}).key != found[0].key
    theirs = next(row for row in found if row.method.name == "theirs" and row.sequence.name == "clips/c2")
    file, before = tmp_path / "data" / "theirs" / "clips" / "c2-0.txt", theirs.key
    file.parent.mkdir(parents=True)
    file.write_text("a file that the plan names")
    assert theirs.key != before
    assert Entry.load(theirs.save()) == theirs


def test_all_methods_are_given_the_same_depth(tmp_path: Path) -> None:
    clip, *_, tube = rows(tmp_path)
    assert clip.shared_settings() == {
        "fusion.enabled": False,
        "depth.backend": f"files:{tmp_path / 'data' / 'depths'}",
        "depth.anchor": "near-far",
        "depth.near_far_mm": (10, 90),
    }
    assert tube.shared_settings()["depth.backend"] == f"files:{tube.source}"
    assert tube.shared_settings()["depth.anchor"] == "auto"
    # A preset does not take the shared depth away.
    config = Config.load("paper", settings=clip.shared_settings())
    assert config.depth.backend.startswith("files:")
    assert config.depth.anchor == "near-far"


def test_what_is_not_there_is_said_and_nothing_at_all_is_an_error(tmp_path: Path) -> None:
    plan = read_plan(written(tmp_path))
    found, missing = found_sequences(plan, tmp_path)
    assert [sequence.name for sequence in found] == ["tube"]
    assert missing == [f"clips/c*: nothing like that in {tmp_path}"]
    assert "--data" in found_sequences(plan, None)[1][0]
    alone = plan.model_copy(update={"sequence": plan.sequence[:1]})
    with pytest.raises(InputError, match=r"no sequence of the plan 'small' is there: clips/c\*"):
        found_sequences(alone, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'name = "ours"',
            'name = "ours"\nsettings = { "tracking.keyframes_every" = 2 }',
            "did you mean 'tracking.keyframe_every'",
        ),
        ('name = "ours"', 'name = "theirs"', "two methods have the name 'theirs'"),
        ('name = "ours"', 'name = "ours"\nuse = "import"', "belong together"),
        ('scene = "tube"', 'scene = "nose"', "scene"),
        ('path = "clips/c*"', "", "either a path or a phantom"),
        ('title = "small"', 'titel = "small"', "titel"),
        ("seeds = [0, 3]", "seeds = [0, 3", "cannot read the plan"),
        ("seeds = [0, 3]", "seeds = " + "[" * 100_000, "cannot read the plan"),
        ("seeds = [0, 3]", f"seeds = [{'9' * 5000}]", "cannot read the plan"),
        ('title = "small"', 'title = "small"\nmethod_sets = ["all"]', "unknown set of methods 'all': choose from abl"),
        (
            'title = "small"',
            'title = "small"\nprotocol = { protocols = ["EVO"] }',
            "unknown protocol 'EVO'",
        ),
        ('title = "small"', 'title = "small"\nprotocol = { flow = "raft" }', "unknown flow 'raft'"),
        ('path = "clips/c*"', 'path = "clips/c*"\ndataset = "c4vd"', "unknown data set 'c4vd'"),
        ("seeds = [0, 3]", "seeds = []", "seeds"),
    ],
)
def test_bad_plans_are_one_clear_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=message) as caught:
        read_plan(written(tmp_path, SMALL.replace(old, new, 1)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", shipped_plans())
def test_plans_that_come_along_name_methods_that_exist(name: str, tmp_path: Path) -> None:
    plan: Plan = read_plan(name)
    assert plan.description.endswith(".")
    for method in plan.method:
        create_method(method, tmp_path)
    with pytest.raises(SettingsError, match=name):
        read_plan(tmp_path / "none.toml")


@pytest.mark.parametrize("name", shipped_plans())
def test_where_the_papers_preset_is_a_method_its_text_alone_is_one_too(name: str) -> None:
    """Ablations change the preset; RAFT small is the same method on a machine without a GPU."""
    own: dict[str | None, list[dict[str, object]]] = {"paper": [], "paper-strict": []}
    for method in read_plan(name).method:
        if (
            method.use == "scopemap"
            and method.preset in own
            and method.settings in ({}, {"networks.flow": "raft-small"})
        ):
            own[method.preset].append(method.settings)
    assert own["paper"] == own["paper-strict"]
    assert bool(own["paper"]) == any(method.preset == "paper" for method in read_plan(name).method)


def test_two_sequences_of_one_name_or_an_unknown_method_are_refused_before_anything_runs(tmp_path: Path) -> None:
    (tmp_path / "clips" / "c1").mkdir(parents=True)
    twice = SMALL.replace("[[method]]", '[[sequence]]\npath = "clips/c1"\n\n[[method]]', 1)
    with pytest.raises(SettingsError, match="two sequences that are called 'clips/c1'"):
        run_plan(read_plan(written(tmp_path, twice)), tmp_path / "out", data=tmp_path)
    unknown = SMALL.replace('name = "ours"', 'name = "ours"\nuse = "slam"')
    with pytest.raises(SettingsError, match="unknown method 'slam': choose one of scopemap, import"):
        run_plan(read_plan(written(tmp_path, unknown)), tmp_path / "out", data=tmp_path)


def test_a_pattern_finds_only_what_the_named_reader_knows_and_a_name_goes_before(tmp_path: Path) -> None:
    write_c3vd(tmp_path / "clip_a", np.tile(np.eye(4), (1, 1, 1)))
    (tmp_path / "clip_a" / "0000_color.png").write_bytes(b"")
    (tmp_path / "clip_a_depth").mkdir()
    (tmp_path / "clip_a.zip").write_bytes(b"")
    (tmp_path / "clip[1]").mkdir()
    plan = read_plan(written(tmp_path))
    for changes, names in (
        ({"path": "clip_a*", "dataset": "c3vd"}, ["clip_a"]),
        ({"path": "clip_a*", "name": "mono"}, ["mono clip_a", "mono clip_a_depth"]),
        ({"path": "clip[1]"}, ["clip[1]"]),
    ):
        sequence = plan.sequence[0].model_copy(update={"dataset": None, "name": ""} | changes)
        found, _ = found_sequences(plan.model_copy(update={"sequence": (sequence,)}), tmp_path)
        assert [item.name for item in found] == names
