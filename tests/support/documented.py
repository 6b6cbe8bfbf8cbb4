"""The commands and the code that the documents show."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from tests.support.places import ROOT

DOCUMENTS = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
DOCUMENTS = sorted({*DOCUMENTS, *(ROOT / "bench").glob("*.md")} - {ROOT / "CHANGELOG.md"})
# Not the name of an image, nor of an import.
CALLED = re.compile(r"(?!podman )(?:.*[\s!(])?scopemap ((?!import)[a-z-].*)")


def blocks(text: str, language: str = r"\w*") -> list[str]:
    """Return the content of code blocks: fenced ones of the language, and indented ones where any will do."""
    fenced = re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    plain = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.findall(r"(?:^ {4}.*\n)+", plain, flags=re.MULTILINE) if language == r"\w*" else []
    return fenced + indented


def commands(document: Path) -> list[list[str]]:
    """Return the arguments of each `scopemap` in the document's blocks of code."""
    found = []
    for block in blocks(document.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            parts = re.split(r"\s(?:&&|\||>|&)\s|;\s", re.sub(r"\s#.*", "", line))
            called = [CALLED.match(part.strip()) for part in parts]
            found += [shlex.split(match[1]) for match in called if match]
    return found
