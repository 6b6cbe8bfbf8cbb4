"""What somebody who uses or reads scopemap has to know, counted: it may become less, not more.

Lines and classes are not counted, since a ceiling on them bends the code. The files that a frame visits are counted in
test_path_of_a_frame.py, sizes of files and functions in test_structure.py.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

from scopemap.engine.config.config import Config, setting_names
from scopemap.engine.config.settings import Settings


def _advanced_settings() -> int:
    return sum(len(part.sources()) for _, part in Config() if isinstance(part, Settings))


def _modules_loaded_after(code: str) -> int:
    told = f"{code}; import sys; print(sum(name.split('.')[0] == 'scopemap' for name in sys.modules))"
    return int(subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True).stdout)


CEILINGS = {
    "settings that can be set": (lambda: len(setting_names()), 80),
    "settings but the advanced ones": (lambda: len(setting_names()) - _advanced_settings(), 46),
    # Readers of formats, networks and pages are loaded when an input, a setting or a command needs them. 153: the log
    # from which a killed run is resumed, in place of a serialiser of all that the stages hold; depth under highlights;
    # the blocks of a TSDF apart from its kernels. 154: the vertices and connected parts of faces, which five modules of
    # fusion found each in its own, slower way.
    "modules loaded by scopemap.reconstruct": (
        lambda: _modules_loaded_after("import scopemap; scopemap.reconstruct"),
        154,
    ),
}


@pytest.mark.parametrize("name", CEILINGS)
def test_ceilings(name: str) -> None:
    measure, most = CEILINGS[name]
    found = measure()
    assert found <= most, f"{name}: {found}, the ceiling is {most}; pay for it, or raise it with a reason"
