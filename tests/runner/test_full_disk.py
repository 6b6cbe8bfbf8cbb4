"""A disk that is full, or gone, while a run writes: one sentence, and nothing is left."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.errors import InputError
from scopemap.result.result_folder import UNFINISHED
from tests.support.tiny_phantom import with_true_depth, write_tiny

pytestmark = pytest.mark.slow

_LIMITED = """
import resource, signal, sys
from scopemap.cli.app import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
main()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


@pytest.mark.skipif(os.name != "posix", reason="files are limited as on POSIX systems")
@pytest.mark.parametrize("most_bytes", [10, 200_000])
def test_a_disk_that_is_full_is_one_sentence_and_nothing_is_left(most_bytes: int, folder: Path, tmp_path: Path) -> None:
    """As a limit on the size of files: of the lock, of the stored frames."""
    ask = ("run", folder, "--out", tmp_path / "out", "--depth", f"files:{folder}", "--quiet")
    command = [sys.executable, "-c", _LIMITED, str(most_bytes), *map(str, ask)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr.count("\n")) == (1, 1), ran.stderr
    assert ran.stderr.startswith("scopemap: cannot ")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_vanishes_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def remove(step: object) -> None:
        shutil.rmtree(out / UNFINISHED, ignore_errors=True)

    with pytest.raises(InputError, match=r"cannot write"):
        reconstruct(open_sequence(folder), with_true_depth(folder), out=out, observers=(remove,))
    assert not out.exists()
