"""What hinders reading in a data set's folders: told before anything is read, as what is not seen is missed by none.

Where a folder may not be entered, asking whether a file lies in it is an error in some versions of Python and "no" in
others: truth would be left out silently. A pipe is worse: whoever opens it waits forever.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from scopemap.errors import InputError

_DEEPEST = 4
_MOST_FOLDERS = 500
# What file systems keep for themselves.
_LOST_AND_FOUND = "lost+found"


def is_apart(name: str) -> bool:
    """Whether a folder is none of a data set by its name: hidden, or kept by the file system for itself."""
    return name.startswith(".") or name == _LOST_AND_FOUND


def may_enter(folder: Path) -> bool:
    """Whether a folder may be listed and entered."""
    return os.access(folder, os.R_OK | os.X_OK)


def hindrances(folder: Path) -> list[str]:
    """Return what in `folder` cannot be read, whoever asks: folders without permission, pipes and devices.

    Links to folders are not followed; four levels and 500 folders are looked at, which is more than any layout has.
    Raises `InputError` where `folder` itself may not be listed and entered.
    """
    if not may_enter(folder):
        raise InputError(f"reading {folder}: no permission to look into it")
    found: list[str] = []
    level, seen = [folder], 0
    for _ in range(_DEEPEST):
        inner: list[Path] = []
        for one in level[: max(_MOST_FOLDERS - seen, 0)]:
            if not may_enter(one):
                found.append(f"no permission to look into {one}")
                continue
            with os.scandir(one) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        inner += [] if is_apart(entry.name) else [Path(entry.path)]
                    elif not entry.is_file(follow_symlinks=False) and _is_endless(entry.path):
                        found.append(f"{entry.path} is a pipe or a device, not a file")
        seen += len(level)
        level = inner
    return found


def _is_endless(path: str) -> bool:
    try:
        mode = os.stat(path).st_mode
    except OSError:  # a link to nowhere
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode)
