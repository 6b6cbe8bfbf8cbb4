"""What is met in Python first: what `dir` and `help` show, and texts where a path, a slice or a preset is meant."""

from __future__ import annotations

import pydoc
from collections.abc import Callable
from pathlib import Path

import pytest

import scopemap
import scopemap_bench
from scopemap import Reconstructor, evaluate_poses, open_sequence, read_trajectory, reconstruct
from scopemap.engine.errors import ScopemapError
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


@pytest.mark.parametrize("package", [scopemap, scopemap_bench], ids=lambda package: package.__name__)
def test_dir_and_help_show_what_is_public(package: object) -> None:
    assert dir(package) == sorted(package.__all__)  # type: ignore[attr-defined]
    shown = pydoc.plain(pydoc.render_doc(package))
    for name in package.__all__:  # type: ignore[attr-defined]
        assert f"    {name}(" in shown or f"class {name}(" in shown or name == "__version__"
    assert "__getattr__" not in shown.split("FUNCTIONS")[1].split("DATA")[0].split("VERSION")[0]


def test_the_lines_that_everyone_needs_are_in_the_docstring() -> None:
    lines = [line.strip() for line in (scopemap.__doc__ or "").splitlines() if line.strip().startswith(">>>")]
    assert len(lines) == 6
    compile("\n".join(line.removeprefix(">>> ") for line in lines), "docstring", "exec")


def test_texts_are_paths_slices_and_presets(phantom: Path) -> None:
    chosen = open_sequence(str(phantom), frames="1:7:2")
    assert chosen.selection == slice(1, 7, 2)
    assert open_sequence(str(phantom), frames=":").count == open_sequence(phantom).count
    result = reconstruct(str(phantom), "realtime")
    assert (result.config.preset, len(result.frames)) == ("realtime", 9)
    errors = evaluate_poses(result.trajectory, str(phantom), "sim3")
    assert repr(errors) == repr(evaluate_poses(result.trajectory, read_trajectory(phantom), "sim3"))
    with Reconstructor("realtime", str(phantom)) as reconstructor:
        assert len([reconstructor.step(frame) for frame in reconstructor.frames()]) == 9


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "frames in words": (lambda path: open_sequence(path, frames="first ten"), "frames 'first ten': expected START"),
    "frames as a number": (lambda path: open_sequence(path, frames=10), "frames '10': expected START"),  # type: ignore[arg-type]
    "a step back": (lambda path: open_sequence(path, frames="9:0:0"), "the step must be positive"),
    "size as a text": (lambda path: open_sequence(path, size="64x48"), r"size '64x48' is invalid: give \(width"),  # type: ignore[arg-type]
    "an unknown preset": (lambda path: reconstruct(path, "fast"), "unknown preset 'fast'"),
    "settings of another kind": (lambda path: reconstruct(path, {"fps": 3}), "holds no settings: give a Config"),  # type: ignore[arg-type]
    "no file": (lambda path: reconstruct("clip.mp4"), "reading clip.mp4: no such file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_neither_is_refused_in_a_sentence(name: str, phantom: Path) -> None:
    call, words = REFUSED[name]
    with pytest.raises(ScopemapError, match=words):
        call(phantom)
