"""`scopemap verify` and the checksums of a result."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from scopemap.apps.verify.verifying import verify_result
from scopemap.report.page import keep_measurements, write_report
from scopemap.result import checksums
from scopemap.result.checksums import SUMS, input_checksum
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    source = write_tiny(folder / "in")
    ask = ("run", source, "--out", folder / "out", "--depth", f"files:{source}", "--frames", "0:5", "--quiet")
    assert call(*ask) == 0
    return folder / "out"


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished, tmp_path / "out")


def _all(folder: Path) -> set[str]:
    return {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()}


def test_a_run_is_whole_and_every_file_has_its_checksum(out: Path, capfd: Capture) -> None:
    lines = [line.split("  ") for line in (out / SUMS).read_text().splitlines()]
    assert {name for _, name in lines} == _all(out) - {SUMS}
    assert {"report.html", "summary.png", "depth/000004.png", "frames/000000.jpg"} < {name for _, name in lines}
    assert all(hashlib.sha256((out / name).read_bytes()).hexdigest() == digest for digest, name in lines)
    assert call("verify", out) == 0
    assert f"{len(lines)} files as they were, 0 damaged, 0 missing" in capfd.readouterr().out
    found = verify_result(out)
    assert (found.is_whole, found.whole, found.added) == (True, len(lines), [])
    assert found.notes[0].startswith("made by scopemap ")


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="no sha256sum here")
def test_sha256sum_reads_them(out: Path) -> None:
    command = ["sha256sum", "--quiet", "--strict", "-c", SUMS]
    assert subprocess.run(command, cwd=out, check=False).returncode == 0
    (out / "mesh.ply").write_bytes(b"")
    assert subprocess.run(command, cwd=out, check=False, capture_output=True).returncode == 1


def test_damaged_missing_and_other_files_are_named(out: Path, capfd: Capture) -> None:
    content = bytearray((out / "depth" / "000002.png").read_bytes())
    content[len(content) // 2] ^= 1
    (out / "depth" / "000002.png").write_bytes(bytes(content))
    (out / "trajectory.tum").unlink()
    (out / "notes.txt").write_text("mine")
    assert call("verify", out, "--json") == 1
    told = json.loads(capfd.readouterr().out)
    assert (told["damaged"], told["missing"], told["added"]) == (
        ["depth/000002.png"],
        ["trajectory.tum"],
        ["notes.txt"],
    )
    assert call("verify", out) == 1
    said = capfd.readouterr().out
    assert "damaged: depth/000002.png\nmissing: trajectory.tum\nnot of the run: notes.txt\n" in said
    assert call("verify", out, "--quiet") == 1
    assert capfd.readouterr().out == ""


def test_an_interrupted_run_and_other_versions_are_told(out: Path) -> None:
    told = json.loads((out / "provenance.json").read_text())
    told["interrupted_at_frame"], told["versions"]["numpy"] = 3, "1.0"
    (out / "provenance.json").write_text(json.dumps(told))
    assert verify_result(out).damaged == ["provenance.json"]
    checksums.write_checksums(out, only=("provenance.json",))
    found = verify_result(out)
    assert found.is_whole
    assert found.notes[0] == "it was interrupted at frame 3"
    assert "numpy 1.0 (here " in found.notes[-1]


@pytest.mark.parametrize("spoil", ["", "nonsense\n", "0" * 64 + "  ../../etc/passwd\n", "0" * 64 + "  mesh.ply\n"])
def test_a_list_that_is_none_is_a_sentence(spoil: str, out: Path, capfd: Capture) -> None:
    (out / SUMS).write_text(spoil)
    assert SUMS in refused(capfd, "verify", out)
    (out / SUMS).unlink()
    assert "no finished run, or one of an earlier version" in refused(capfd, "verify", out)


def test_a_list_that_breaks_off_is_told(out: Path, capfd: Capture) -> None:
    text = (out / SUMS).read_text()
    for kept in (len(text) - 1 - 81, len(text) // 2):
        (out / SUMS).write_text(text[: text.rindex("\n", 0, kept) + 1])
        assert f"{SUMS} is damaged, it does not name" in refused(capfd, "verify", out)


def test_a_report_that_is_written_again_stays_whole_and_hides_no_damage(out: Path) -> None:
    (out / "depth" / "000002.png").write_bytes(b"")
    write_report(out)
    found = verify_result(out)
    assert (found.damaged, found.missing, found.added) == (["depth/000002.png"], [], [])


def test_what_the_window_adds_is_known_and_leaves_the_result_whole(out: Path) -> None:
    keep_measurements(out, b"[]")
    for name in ("exports/stl.stl", "exports_of_mine.stl"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_bytes(b"solid")
    found = verify_result(out)
    assert found.is_whole  # the report, too, which has what is measured at once
    assert (found.later, found.added) == (["measurements.json", "exports/stl.stl"], ["exports_of_mine.stl"])


def test_a_run_names_its_input_by_its_content(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = json.loads((out / "provenance.json").read_text())["input_content"]
    assert kept["files"] > 10
    assert len(kept["sha256"]) == 64
    file = tmp_path / "clip.bin"
    file.write_bytes(bytes(range(200)))
    assert input_checksum(file) == {"bytes": 200, "sha256": hashlib.sha256(bytes(range(200))).hexdigest()}
    first = input_checksum(tmp_path / "out")
    (tmp_path / "out" / "depth" / "000001.png").write_bytes(b"")
    assert input_checksum(tmp_path / "out")["sha256"] != first["sha256"]
    monkeypatch.setattr(checksums, "_MOST_INPUT_BYTES", 100)
    part, changed = hashlib.sha256(bytes([*range(50), *range(150, 200)])).hexdigest(), file.stat().st_mtime_ns
    assert input_checksum(file) == {"bytes": 200, "sha256": part, "hashed_bytes": 100, "changed_ns": changed}
    before = input_checksum(file)
    os.utime(file, ns=(0, changed + 10**9))
    assert input_checksum(file) != before
    monkeypatch.setattr(checksums, "_MOST_INPUT_FILES", 3)
    assert input_checksum(tmp_path / "out") == {"files": "more than 3"}
    assert input_checksum(tmp_path / "absent") == {}
