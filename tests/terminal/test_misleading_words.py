"""What the terminal says of a result: one value for a figure, why an interval is wide, whose a file is."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

from scopemap.apps.measure.intervals import LogChanges
from scopemap.apps.measure.measure import Measure
from scopemap.apps.verify.verifying import verify_result
from scopemap.cli import app as cli
from scopemap.result.checksums import write_checksums
from scopemap.result.summary import summary_lines
from tests.support.drawn_run import GOOD_SURFACE, draw_run, drawn_result
from tests.support.front_door import call


@pytest.mark.parametrize("name", cli._OF_BENCH)
def test_a_command_of_a_missing_package_names_the_package(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    group = get_command(cli.app)
    group.commands.pop(name)
    with pytest.raises(SystemExit) as ended:
        group.main([name, "scared"], prog_name="scopemap")
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert ended.value.code == 2
    assert f"{name} is a command of the package scopemap-bench, which is not installed" in said
    assert "pip install -c constraints.txt -e bench" in said
    assert "Did you mean" not in said


@pytest.mark.parametrize("error", [0.19851, 0.1985, 0.1989, 0.2, 0.00999])
@pytest.mark.parametrize("coverage", [0.29, 0.939, 0.9999])
def test_summary_and_verdict_print_one_value_of_a_figure(error: float, coverage: float) -> None:
    surface = GOOD_SURFACE | {"depth_error": error, "coverage_mean": coverage}
    said = "\n".join(summary_lines(drawn_result(surface=surface)))
    assert len(set(re.findall(r"depth differs by ([\d.]+) %", said))) == 1
    assert len(set(re.findall(r"covers ([\d.]+) %", said))) == 1


def test_verify_tells_what_scopemap_added_from_what_is_foreign(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = draw_run(tmp_path / "result")
    write_checksums(run)
    later = ["against_video/worst.png", "coverage/coverage.json", "coverage/map.csv", "maps/1/coverage/coverage.ply"]
    foreign = ["coverage/notes.txt", "maps/1/mine.csv", "notes.txt"]
    for name in (*later, *foreign):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("x")
    found = verify_result(run)
    assert (found.is_whole, found.later, sorted(found.added)) == (True, later, foreign)
    capfd.readouterr()
    assert call("verify", run) == 0
    said = capfd.readouterr().out
    assert "added by scopemap after the run: coverage/coverage.json" in said
    assert "not of the run: coverage/coverage.json" not in said
    assert "not of the run: notes.txt" in said


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (LogChanges.of_scale(0.3), "the scale"),
        (LogChanges.of_own(0.3), "the depth and the place of the single points"),
        (LogChanges(np.array([[-0.5, 0.5], [0.1, -0.1], [0, 0]])), "the depth of the frame"),
        (LogChanges(np.array([[0, 0], [0.4, -0.5], [0.1, 0.1]])), "the focal length"),
    ],
)
def test_a_wide_interval_says_why(source: LogChanges, words: str) -> None:
    wide = Measure.of("straight", 10.0, source, "mm")
    assert wide.why == words
    assert str(wide).endswith(f"; wide mainly because of {words})")
    assert "wide" not in str(Measure.of("straight", 10.0, source.to_power(0.1), "mm"))
