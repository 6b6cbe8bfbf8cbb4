"""The files of the repository: their sizes, and what none of them names."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.places import ROOT

# The one network that the package brings along.
ALLOWED_BYTES = {"src/scopemap/engine/depth/scopenet/scopenet.onnx": 8_000_000}


def _project_files() -> list[Path]:
    """What git tracks, and what it would track."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    # Somebody's virtual environment in the clone, whatever its name, is no part of the project.
    environments = tuple(file.parent for file in ROOT.glob("*/pyvenv.cfg"))
    paths = (ROOT / name for name in listed.splitlines())
    return [path for path in paths if path.is_file() and not any(map(path.is_relative_to, environments))]


def test_no_file_is_large() -> None:
    sizes = [(path.relative_to(ROOT).as_posix(), path.stat().st_size) for path in _project_files()]
    _none([f"{name}: {size} bytes" for name, size in sizes if size > ALLOWED_BYTES.get(name, 1_000_000)])


@pytest.mark.parametrize(
    ("what", "pattern"),
    [
        ("a package registry's address", r"https?://[^\s/\"')]*(pypi|pythonhosted|npmjs|crates\.io|conda|artifactory)"),
        ("a host by its number", r"https?://\d+\.\d+\.\d+\.\d+"),
        ("a path of one machine", r"(?<![\w.}])/(work|root|home)/\w"),
    ],
)
def test_no_file_names(what: str, pattern: str) -> None:
    found = []
    for path in _project_files():
        content = path.read_bytes()
        if b"\0" in content[:1000]:
            continue
        for number, line in enumerate(content.decode("utf-8", errors="ignore").splitlines(), start=1):
            if re.search(pattern, line):
                found.append(f"{path.relative_to(ROOT)}:{number} holds {what}: {line.strip()[:100]}")
    _none(found)


def _none(faults: list[str]) -> None:
    assert not faults, "\n" + "\n".join(faults)
