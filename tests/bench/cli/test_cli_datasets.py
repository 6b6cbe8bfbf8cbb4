"""`scopemap datasets list` and `check`: what they print, and their exit codes."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from scopemap.cli.app import main
from scopemap.input.opening import readers
from tests.support.drawn_inputs import picture, save, write_c3vd

Say = Callable[..., tuple[int, str, str]]


@pytest.fixture
def datasets(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Say:
    """The command `scopemap datasets`: exit code, stdout, stderr."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["scopemap", "datasets", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        said = capfd.readouterr()
        return int(caught.value.code or 0), said.out, said.err

    return call


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    folder = write_c3vd(tmp_path / "sound", count=4)
    for file in folder.glob("*_depth.tiff"):
        file.unlink()
    return folder


@pytest.fixture
def faulty(tmp_path: Path) -> Path:
    folder = tmp_path / "faulty[1]"
    folder.mkdir()
    for number, name in enumerate(("a_1.png", "b_1.png", "c_2.png")):
        save(folder / name, picture(number))
    return folder


def test_a_sound_set_is_code_0(datasets: Say, sound: Path) -> None:
    code, out, err = datasets("check", sound)
    assert (code, err) == (0, "checked 4 of 4 frames\n")
    assert "errors: 0, warnings: 0" in out
    assert re.search(r"with_pose\W+4\b", out)
    assert "time stamps: frame number / 30 s" in out
    assert datasets("check", sound, "--quiet") == (0, "", "")
    assert datasets("check", sound, "--json")[2] == ""


def test_an_error_is_code_1_and_one_line(datasets: Say, faulty: Path) -> None:
    code, out, err = datasets("check", faulty, "--json")
    assert code == 1
    assert err.startswith(f"scopemap: checking {faulty}: number-repeated: names repeat the number of frame 1")
    assert err.count("\n") == 1
    told = json.loads(out)
    assert list(told) == ["path", "figures", "findings"]
    assert (told["figures"]["dataset"], told["figures"]["frames"]) == ("images", 3)
    assert told["findings"][0].keys() == {"severity", "code", "message"}
    assert (told["findings"][0]["severity"], told["findings"][0]["code"]) == ("error", "number-repeated")
    assert {finding["severity"] for finding in told["findings"][1:]} == {"info", "warning"}
    code, out, err = datasets("check", faulty)
    assert (code, err.count("\n")) == (1, 2)
    assert out.startswith(f"{faulty}\n")
    assert re.search(r"error +│ number-repeated +│ names repeat", out)
    assert datasets("check", faulty, "--quiet")[:2] == (1, "")


def test_what_cannot_be_opened_is_found_too(datasets: Say, sound: Path) -> None:
    code, out, err = datasets("check", sound / "nowhere", "--json")
    assert (code, [finding["code"] for finding in json.loads(out)["findings"]]) == (1, ["refused"])
    assert "no such file or folder" in err
    assert "unknown data set 'nothing'" in datasets("check", sound, "--dataset", "nothing")[2]
    (sound / "no.yaml").write_text("hello")
    code, out, _ = datasets("check", sound, "--camera", sound / "no.yaml")
    assert (code, "camera-refused" in out) == (1, True)


def test_the_reader_and_the_camera_can_be_named(datasets: Say, sound: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("120 121 67 54")
    arguments = ("--dataset", "images", "--camera", tmp_path / "mine.txt", "--json")
    code, out, _ = datasets("check", sound, *arguments)
    figures = json.loads(out)["figures"]
    assert (code, figures["dataset"], figures["fx"], figures["with_pose"]) == (0, "images", 120, 0)


def test_list_names_every_reader(datasets: Say) -> None:
    code, out, err = datasets("list", "--json")
    rows = json.loads(out)
    assert (code, err, [row["name"] for row in rows]) == (0, "", list(readers()))
    assert all(row["what"] and row["recognised"] for row in rows)
    told = {row["name"]: row for row in rows}
    assert told["c3vd"]["what"].startswith("C3VD: phantom colonoscopy")
    assert told["video"]["recognised"] == "It is a file."
    assert told["oneslam"]["recognised"] == "It holds pictures `images/*`, and `calibration.json`."
    cells = [cell for row in rows for cell in (row["what"], row["recognised"])]
    assert all(cell[0].isupper() or cell[0].isdigit() for cell in cells)
    assert all(cell.endswith(".") and not re.search("Return|`path`|layout is|derive", cell) for cell in cells)
    table = datasets("list")[1]
    assert all(re.search(rf"│ {re.escape(name)} ", table) for name in readers())
    assert datasets("list", "--quiet") == (0, "", "")
