"""Fixtures shared by all tests: where the real data lie, if they do."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real frames and weights (docs/install.md, "Tests"); the test skips where it is absent."""
    folder = Path(os.environ.get("SCOPEMAP_REAL_DATA", _DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"real data not found in {folder}; set SCOPEMAP_REAL_DATA to run this test")
    return folder
