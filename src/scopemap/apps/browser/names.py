"""Names of files as the page shows them: as they are, or "video 1" where nobody is to read them (`--anonymous`)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from scopemap.apps.browser.uploads import UNKNOWN_KIND

_PLACES = ("the folder", "folder")
"""What stands for the folder of the videos, with and without its own name."""


class Names:
    """Names of files, and what stands for them; anonymous : whether they are hidden."""

    def __init__(self, *, anonymous: bool = False) -> None:
        self.anonymous = anonymous
        self._of: dict[tuple[str, Path], str] = {}
        self._instead: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._left_out: set[str] = set()
        self._lengthened: set[str] = set()

    def leave_out(self, folder: Path) -> None:
        """Show files of a folder by their names alone: it is a temporary one, of which nobody knows."""
        self._left_out |= {f"{folder}/", f"{folder.resolve()}/"}

    def hide_folder(self, folder: Path) -> None:
        """Show no part of where a folder is."""
        for path in {str(folder.resolve()), str(folder)} - {"."}:
            self._instead[path] = _PLACES[0]
        if folder.resolve().name:
            self._instead[folder.resolve().name] = _PLACES[1]

    def of(self, path: Path, kind: str) -> str:
        """Return the name of a file or folder; hidden: its kind and a number, the same each time."""
        if not self.anonymous:
            name = path.name.removesuffix(UNKNOWN_KIND)
            self._lengthened |= {path.name} - {name}
            return name
        key = kind, path.absolute()
        if key not in self._of:
            self._counts[kind] = self._counts.get(kind, 0) + 1
            self._of[key] = alias = f"{kind} {self._counts[kind]}"
            for name in (path.name, path.stem):
                self._instead.setdefault(name, alias)
        return self._of[key]

    def labelled(self, paths: Iterable[Path], kind: str) -> dict[str, Path]:
        """Return paths by what is shown of them; those of one name are numbered."""
        out: dict[str, Path] = {}
        for path in paths:
            name = label = self.of(path, kind)
            number = 1
            while label in out:
                label = f"{name} ({(number := number + 1)})"
            out[label] = path
        return out

    def hidden(self, text: str) -> str:
        """Return a text without temporary folders, and with names of files as `of` returns them."""
        for folder in sorted(self._left_out, key=len, reverse=True):  # one may be inside of another
            text = text.replace(folder, "")
        for name in self._lengthened:
            text = text.replace(name, name.removesuffix(UNKNOWN_KIND))
        if not (self.anonymous and self._instead):
            return text
        # The longest first: a folder's path before its name, "a_2" before "a".
        names = "|".join(re.escape(name) for name in sorted(self._instead, key=len, reverse=True) if name)
        # "colon" in "colon_2.mp4", too, but not in "colonoscope".
        return re.sub(rf"(?<![^\W_])(?:{names})(?![^\W_])", lambda found: self._instead[found[0]], text)
