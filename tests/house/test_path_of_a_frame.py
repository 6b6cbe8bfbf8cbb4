"""The files that a frame visits from the command line to the mesh, traced in a small default run."""

from __future__ import annotations

import re
import sys
import threading
from pathlib import Path
from types import FrameType

import pytest

import scopemap
from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.frame import Frame
from tests.support.places import ROOT
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

SOURCE = Path(scopemap.__file__).parent
# With what comes after the last frame, and which frames can be tracked, are keyframes and are fused, in files of their
# own.
MOST_FILES = 30


def _carries_frame(value: object) -> bool:
    if isinstance(value, Frame):
        return True
    fields = getattr(type(value), "__dataclass_fields__", ())
    return any(isinstance(getattr(value, name, None), Frame) for name in fields)


def _path(folder: Path) -> set[str]:
    """The files in which some function received or returned a frame, or what carries one, during a default run."""
    files: set[str] = set()

    def note(call: FrameType, event: str, argument: object) -> None:
        code = call.f_code
        if event not in ("call", "return") or not code.co_filename.startswith(str(SOURCE)):
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        values = [argument] if event == "return" else [call.f_locals.get(name) for name in names]
        if any(_carries_frame(value) for value in values):
            files.add(Path(code.co_filename).relative_to(SOURCE).as_posix())

    sequence = open_sequence(write_tiny(folder / "phantom", frames=6))
    settings = {"networks.flow": "dis", "networks.perceptual": "structure", "tracking.keyframe_every": 2}
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        reconstruct(sequence, Config.load(settings=settings), out=folder / "out")
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    # What is written down for a run that resumes this one changes no frame. The surface is checked and its texture made
    # with few frames, not with each one; ARCHITECTURE.md has these files below the table.
    few = {"runner/texturing.py"} | {
        f"engine/fusion/{part}.py" for part in ("agreement", "texture_views", "texture_alignment")
    }
    assert few <= files
    return (files - few - {"runner/checkpoints.py", "runner/tracking_log.py"}) | {
        "apps/run/command.py",
        "runner/run.py",
    }


def test_a_frame_visits_few_files_and_the_architecture_names_them(tmp_path: Path) -> None:
    path = _path(tmp_path)
    assert {
        f"engine/{name}.py" for name in ("pipeline", "masking/masker", "tracking/tracker", "fusion/surface_fusion")
    } <= path
    assert len(path) <= MOST_FILES, "\n".join(sorted(path))
    section = (
        (ROOT / "ARCHITECTURE.md")
        .read_text(encoding="utf-8")
        .partition("## The path of a frame")[2]
        .partition("\n## ")[0]
    )
    assert [file for file in sorted(path) if file not in section] == []


def test_the_architecture_names_files_that_exist() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = {
        name for name in re.findall(r"`([a-z_/]+\.(?:py|toml))`", text) if not name.startswith(("tests/", "bench/"))
    }
    named -= {"config.toml", "pyproject.toml"}
    assert len(named) > 25
    assert sorted(name for name in named if not (SOURCE / name).is_file()) == []
