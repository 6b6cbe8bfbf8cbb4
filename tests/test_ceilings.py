"""What somebody who uses or reads scopemap has to know, counted: it may become less, not more.

Lines in total are not counted, since a ceiling on them bent the code. The files that a frame visits are counted in
test_path_of_a_frame.py, sizes of files and functions in test_structure.py.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import scopemap
from scopemap.engine.config.config import Config, setting_names
from scopemap.engine.config.settings import Settings

ENGINE = Path(scopemap.__file__).parent / "engine"


def _advanced_settings() -> int:
    return sum(len(part.sources()) for _, part in Config() if isinstance(part, Settings))


def _modules_loaded_after(code: str) -> int:
    told = f"{code}; import sys; print(sum(name.split('.')[0] == 'scopemap' for name in sys.modules))"
    return int(subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True).stdout)


def _engine_classes() -> int:
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in ENGINE.rglob("*.py")]
    return sum(isinstance(node, ast.ClassDef) for tree in trees for node in tree.body)


CEILINGS = {
    "settings that can be set": (lambda: len(setting_names()), 80),
    "settings but the advanced ones": (lambda: len(setting_names()) - _advanced_settings(), 46),
    # Readers of formats, networks and pages are loaded when an input, a setting or a command needs them.
    "modules loaded by scopemap.reconstruct": (
        lambda: _modules_loaded_after("import scopemap; scopemap.reconstruct"),
        150,
    ),
    # 205: the decision on a keyframe, what the steps after the last frame are carried out by, kinds of lenses, the
    # vertices of a texture's charts, where charts are.
    "classes of the engine": (_engine_classes, 205),
    # 181: what follows after the last frame, too.
    "lines of pipeline.py": (lambda: len((ENGINE / "pipeline.py").read_text().splitlines()), 181),
}


@pytest.mark.parametrize("name", CEILINGS)
def test_ceilings(name: str, record_property: pytest.FixtureRequest) -> None:
    measure, most = CEILINGS[name]
    found = measure()
    record_property(name, found)  # type: ignore[operator]
    assert found <= most, f"{name}: {found}, the ceiling is {most}; pay for it, or raise it with a reason"
