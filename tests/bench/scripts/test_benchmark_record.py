"""The tables of bench/results/: which are older than the code, and what is written when they are made."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from scopemap.input.scopes import SCOPES
from scopemap_bench.scripts import record
from scopemap_bench.scripts.unknown_lenses import ENDOSCOPES


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project of one commit, with two tables: one printed, one written to a file by its command."""
    monkeypatch.setattr(record, "ROOT", tmp_path)
    monkeypatch.setattr(record, "RESULTS", tmp_path / "bench" / "results")
    writes = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text('# Title\\n\\n| 2 |\\n')"
    tables = {
        "printed": ("python -c \"import sys; print('| 1 |', len(sys.argv[1]) > 4)\" DATA", ""),
        "filed": (f'python -c "{writes}" OUT/table.md', "table.md"),
    }
    monkeypatch.setattr(record, "TABLES", tables)
    for folder in record.MEASURED:
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "code.py").write_text("")
    commit(tmp_path, "init")
    return tmp_path


def commit(folder: Path, message: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), (*who, "commit", "-q", "-m", message)):
        subprocess.run(["git", *words], cwd=folder, check=True)


def test_tables_are_outdated_by_a_commit_to_the_measured_sources_alone(project: Path) -> None:
    assert record.outdated() == [
        f"{name}: unknown commits to the sources since it was measured" for name in record.TABLES
    ]
    record.make(list(record.TABLES), project)
    commit(project, "tables")
    assert record.outdated() == []
    (project / "README.md").write_text("words")
    commit(project, "words")
    assert record.outdated() == []
    for count, folder in enumerate(record.MEASURED, start=1):
        (project / folder / "code.py").write_text("x = 1")
        commit(project, folder)
        assert record.outdated()[0] == f"printed: {count} commits to the sources since it was measured"


def test_a_table_names_its_command_and_commit_and_no_folder_of_this_machine(project: Path) -> None:
    record.make(["printed", "filed"], project)
    head = record.git("rev-parse", "--short", "HEAD")
    printed, filed = ((record.RESULTS / f"{name}.md").read_text() for name in ("printed", "filed"))
    assert printed.startswith(f"# printed\n\nCommit {head}, ")
    assert printed.endswith("\n\n| 1 | True\n")
    assert "    python -c" in printed
    assert str(project) not in printed
    assert filed.endswith("OUT/table.md\n\n| 2 |\n")


def test_no_table_is_made_of_code_that_is_not_committed_or_by_a_command_that_fails(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(record.TABLES, "broken", ('python -c "raise SystemExit(3)"', ""))
    with pytest.raises(SystemExit, match="failed with exit code 3"):
        record.make(["broken"], project)
    (project / "src" / "code.py").write_text("x = 2")
    with pytest.raises(SystemExit, match="commit first"):
        record.make(["printed"], project)
    assert not record.RESULTS.exists()


@pytest.mark.parametrize("name", [name for name, (command, _) in record.TABLES.items() if record.PLAN in command])
def test_no_table_is_made_of_a_plan_whose_rows_lack_packages_weights_or_sequences(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of these would be rows without figures, and nothing in the table's file would fail."""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", "")  # which is restored
    monkeypatch.setattr(record, "git", lambda *arguments: "")
    monkeypatch.setattr(record, "record", lambda *arguments: pytest.fail("a table was made"))
    for package in ("open3d", "torch", "torchvision", "lpips"):  # a module of None cannot be found
        monkeypatch.setitem(sys.modules, package, None)
    # A folder is enough where a row lacks what its sequence does not tell.
    (tmp_path / "endoscopy/c3vd/cecum_t1_a").mkdir(parents=True)
    with pytest.raises(SystemExit) as refused:
        record.make([name], tmp_path)
    said = str(refused.value)
    assert said.startswith(f"record: the table {name} would have rows without figures: ")
    assert "needs torch and torchvision and lpips: pip install -c constraints.txt -e '.[networks]'; " in said
    assert "; needs weights: " in said
    assert ("needs Open3D: pip install -c constraints.txt -e './bench[baselines]'" in said) == (name == "methods")
    with pytest.raises(SystemExit, match=f"the table {name} .*cecum_t1_a: nothing like that in {tmp_path / 'none'}"):
        record.make([name], tmp_path / "none")


def test_the_tables_are_fourteen_and_what_is_kept_is_theirs() -> None:
    assert len(record.TABLES) == 14
    assert {file.stem for file in record.RESULTS.glob("*.md")} <= set(record.TABLES)


def test_unknown_lenses_are_of_every_kind_of_endoscope() -> None:
    shares = {one.name: one.camera.central.fx / one.camera.width for one in ENDOSCOPES}
    assert {one.kind for one in ENDOSCOPES} == set(SCOPES)
    # A label of 140 degrees where one of 170 has the focal length of C3VD's lens.
    assert shares["GIF-H190, label 140 deg"] == pytest.approx(0.5698 * 0.9962 / 0.9397, rel=1e-3)
    assert shares["PillCam SB3, label 156 deg"] == pytest.approx(0.5**0.5 / 1.3614, rel=1e-3)
