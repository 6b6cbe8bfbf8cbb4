"""Whether the folders of a data set may be read at all: told before anything is, as what is not seen is missed by none.

Where a folder may not be entered, asking whether a file lies in it is an error in some versions of Python and "no" in
others: truth would be left out silently.
"""

from __future__ import annotations

import os
from pathlib import Path

from scopemap.errors import InputError

_DEEPEST = 4
_MOST_FOLDERS = 500


def check_readable(folder: Path) -> None:
    """Raise `InputError` that names the first folder, `folder` or one in it, that may not be listed and entered.

    Links are not followed; four levels and 500 folders are looked at, which is more than any layout has.
    """
    level, seen = [folder], 0
    for _ in range(_DEEPEST):
        inner: list[Path] = []
        for one in level[: max(_MOST_FOLDERS - seen, 0)]:
            if not os.access(one, os.R_OK | os.X_OK):
                raise InputError(f"reading {folder}: no permission to look into {one}")
            with os.scandir(one) as entries:
                inner += [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
        seen += len(level)
        level = inner
