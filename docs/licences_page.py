"""The page of licences, docs/licences.md, from what is installed here: `python docs/licences_page.py`.

A package that is not installed here has no row: write the page where all extras are.
"""

from __future__ import annotations

import re
import textwrap
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

from scopemap.engine.models.weights import REGISTRY

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "licences.md"
NOTICE = ROOT / "src" / "scopemap" / "engine" / "tracking" / "alike.LICENSE.txt"
_HEAD = """# Licences

Licences of scopemap, of what is installed with it, and of weights. scopemap and scopenet are under Apache-2.0, the
weights of ALIKE-t under BSD-3-Clause. The core needs only packages with permissive licences; extras also bring MPL-2.0
and NVIDIA's own for CUDA. PyAV's wheel holds FFmpeg with x264 and x265 (GPL-2.0-or-later), OpenCV's holds FFmpeg
(LGPL-2.1-or-later): who passes on an image or installer with these wheels does so under these licences.
`python docs/licences_page.py` writes this page.
"""
# What their metadata leave out or say in a whole text, as in the files they bring.
_STATED = {
    "cuda-toolkit": "LicenseRef-NVIDIA-Proprietary",
    "openexr": "BSD-3-Clause",
    "apsw": "any-OSI",
}
_WORDS = (
    (r"NVIDIA", "LicenseRef-NVIDIA-Proprietary"),
    (r"MPL|Mozilla", "MPL-2.0"),
    (r"Apache", "Apache-2.0"),
    (r"BSD", "BSD"),
    (r"\bMIT\b", "MIT"),
    (r"ISC", "ISC"),
    (r"PSF|Python Software Foundation", "PSF-2.0"),
)


def _wanted() -> tuple[list[str], dict[str, list[str]]]:
    """Return what the core needs, and what each extra and the package scopemap-bench need besides."""
    files = (ROOT / "pyproject.toml", ROOT / "bench" / "pyproject.toml")
    core, bench = (tomllib.loads(file.read_text(encoding="utf-8"))["project"] for file in files)
    return core["dependencies"], {
        **core["optional-dependencies"],
        "bench": bench["dependencies"],
        **bench["optional-dependencies"],
    }


def dependencies(extra: str = "") -> dict[str, str]:
    """Return the licence of each package that the core needs, or an extra besides, by name; those installed here."""
    core, extras = _wanted()
    wanted = extras[extra] if extra else core
    todo, found = [Requirement(text) for text in wanted], dict[str, str]()
    while todo:
        one = todo.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name.startswith("scopemap") or (name in found and not one.extras):
            continue
        try:
            package = distribution(one.name)
        except PackageNotFoundError:
            continue
        found[name] = licence_of(one.name)
        inner = [Requirement(text) for text in package.requires or []]
        extras = ("", *one.extras)
        todo += [r for r in inner if r.marker is None or any(r.marker.evaluate({"extra": e}) for e in extras)]
    return found


def licence_of(name: str) -> str:
    """Return the licence that a package states: its SPDX expression, else the words of its metadata as such."""
    facts, key = distribution(name).metadata, re.sub(r"[-_.]+", "-", name).lower()
    if key in _STATED:
        return _STATED[key]
    if facts.get("License-Expression"):
        return str(facts["License-Expression"])
    classifiers = [text for text in facts.get_all("Classifier") or [] if text.startswith("License ::")]
    for text in (*classifiers, (facts.get("License") or "").strip().split("\n")[0]):
        for words, licence in _WORDS:
            if re.search(words, text):
                return licence
    return "unknown"


def licences_page() -> str:
    """Return docs/licences.md."""
    core, lines = dependencies(), [_HEAD]
    rows = {name: (licence, "core") for name, licence in core.items()}
    for extra in _wanted()[1]:
        if extra != "dev":
            for name, licence in dependencies(extra).items():
                rows.setdefault(name, (licence, extra))
    lines.append("\n## Packages\n\n| package | licence | of |\n|---|---|---|\n")
    lines += [f"| {name} | {licence} | {of} |\n" for name, (licence, of) in sorted(rows.items())]
    lines.append("\n## Weights\n\n| weights | licence |\n|---|---|\n| scopenet | Apache-2.0 |\n")
    lines.append("| ALIKE-t, part of the package | BSD-3-Clause, notice below |\n")
    lines += [f"| {one.name} | {one.licence} |\n" for one in REGISTRY.values()]
    notice = textwrap.indent(NOTICE.read_text(encoding="utf-8"), "    ")
    lines.append(f"\n## Notice of ALIKE-t\n\nOf the weights in `src/scopemap/engine/tracking/alike.onnx`:\n\n{notice}")
    return "".join(lines)


if __name__ == "__main__":
    PAGE.write_text(licences_page(), encoding="utf-8")
