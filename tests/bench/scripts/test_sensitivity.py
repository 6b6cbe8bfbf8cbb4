"""Numbers of the source that are changed one at a time: found, changed before another module takes them, compared."""

from __future__ import annotations

import ast
import importlib
import math
import subprocess
import sys
from pathlib import Path

import pytest

from scopemap.engine.mapping import judge
from scopemap_bench.scripts import sensitivity
from scopemap_bench.scripts.sensitivity import Number, moved
from scopemap_bench.scripts.with_number import _Finder, constant_of, is_compiled

KERNEL = "A = 3\n_B = 4\n\n@kernel\ndef f(x):\n    return x + _B\n\ndef g(x):\n    return x + A\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("_A = 3", ("_A", 3)),
        ("A: float = -2 / 4", ("A", -0.5)),
        ("A = 1 << 21", ("A", 2097152)),
        *((text, None) for text in ("A = True", "A = 'x'", "A = (1, 2)", "A = B = 1", "A = f(1)", "A: int", "f(1)")),
    ],
)
def test_plain_numbers_are_found(text: str, found: tuple[str, float] | None) -> None:
    assert constant_of(ast.parse(text).body[0]) == found


def test_a_number_is_changed_before_others_take_it_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "numbers_of.py").write_text("A = 2\nB = A * 3\n")
    (tmp_path / "takes_over.py").write_text("from numbers_of import A\nC = A + 1\n")
    monkeypatch.setattr(sys, "meta_path", [_Finder("numbers_of", "A", 5), *sys.meta_path])
    assert (importlib.import_module("takes_over").C, importlib.import_module("numbers_of").B) == (6, 15)
    assert not list((tmp_path / "__pycache__").glob("numbers_of*"))


def test_kernels_that_hold_a_number_are_known(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(KERNEL)
    assert is_compiled("_B", tmp_path / "module.py", tmp_path)
    assert not is_compiled("A", tmp_path / "module.py", tmp_path)


def test_what_is_no_command_does_not_keep_the_next_from_running() -> None:
    script = [sys.executable, "-m", "scopemap_bench.scripts.with_number"]
    words = ["scopemap.engine.mapping.judge", "_NOISE_PX", "0.1", "no-such-command", "--version"]
    done = subprocess.run([*script, *words], capture_output=True, text=True, check=True)
    assert "no-such-command: No such command" in done.stderr
    assert done.stdout.startswith("scopemap ")


def test_all_numbers_of_the_stages_are_there() -> None:
    found = {one.name: one for one in (*sensitivity.settings(), *sensitivity.constants())}
    assert found["mapping.judge._NOISE_PX"].value == judge._NOISE_PX
    assert found["mapping.local_window"] == Number("mapping.local_window", 5)
    assert not any(name.startswith(("fusion.texture", "tracking.alike")) for name in found)


def test_whole_numbers_stay_whole() -> None:
    assert [Number("n", value).times(factor) for value in (1, 5, 0.3) for factor in (0.5, 2.0)] == [
        1,
        2,
        2,
        10,
        0.15,
        0.6,
    ]


def test_the_largest_change_is_named_and_what_a_run_says() -> None:
    before = {"one": {"path_mm": 0.2, "abs_rel": 0.04, "lost": 0.0, "good": 1.0}, "two": {"depth_error": 0.01}}
    after = {"one": {"path_mm": 0.21, "abs_rel": 0.03, "lost": 2.0, "good": 1.0}, "two": {"depth_error": 0.011}}
    assert moved(before, after) == (pytest.approx(-0.25), "one, abs_rel; one: lost 0 -> 2")
    assert moved(before, before) == (0.0, "")
    assert moved(before, after | {"two": {}}) == (math.inf, "two fails")


def test_what_is_measured_is_kept_and_a_part_is_every_nth(tmp_path: Path) -> None:
    sensitivity.keep(tmp_path, "", 1.0, {"one": {"path_mm": 0.5}})
    sensitivity.keep(tmp_path, "mapping.x", 2.0, {})
    assert sensitivity.known(tmp_path) == {("", 1.0): {"one": {"path_mm": 0.5}}, ("mapping.x", 2.0): {}}
    assert sensitivity.part("2/3") == (2, 3)
    for wrong in ("0/3", "4/3", "1", "a/b"):
        with pytest.raises(Exception, match="expected K/N"):
            sensitivity.part(wrong)
