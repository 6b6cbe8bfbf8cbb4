"""Without the extra `networks`: a run needs none of its packages, and what needs them says which extra to install."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.perceptual import create_perceptual
from scopemap.engine.errors import SettingsError
from scopemap.engine.flow.flows import create_flow
from scopemap.engine.models import weights
from scopemap.runner.depth_backends import create_depth
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom

pytestmark = pytest.mark.slow

PACKAGES = ("torch", "torchvision", "transformers", "huggingface_hub", "safetensors", "lpips")
COMMAND = f"""
import sys
from importlib.machinery import PathFinder


class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.split(".")[0] in {PACKAGES!r} else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Without
from scopemap.cli.app import main

main()
"""
CAMERA = PinholeCamera(40.0, 42.0, 28.0, 26.0, 61, 50)


def _depth(backend: str) -> Callable[[], object]:
    return lambda: create_depth(DepthSettings(backend=backend), Rectifier(CAMERA, CAMERA), "cpu")


@pytest.mark.parametrize(
    ("ask", "fault"),
    [
        (lambda: create_flow("raft-small"), "the flow raft-small needs torch and torchvision: "),
        (lambda: create_perceptual("lpips"), "LPIPS needs torch and torchvision and lpips: "),
        (_depth("depth-anything"), "depth by depth-anything needs torch and torchvision and transformers and "),
        (_depth("depth-pro"), "depth by depth-pro needs torch and torchvision and transformers and "),
        (lambda: weights.pull("raft-small"), "pulling raft-small needs torch and torchvision: "),
        (lambda: weights.pull("depth-anything"), "pulling depth-anything needs huggingface_hub: "),
    ],
)
def test_what_needs_the_extra_names_it(
    ask: Callable[[], object], fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    for package in PACKAGES:  # a module of None cannot be imported
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SettingsError) as caught:
        ask()
    assert str(caught.value).startswith(fault)
    assert str(caught.value).endswith(": pip install -c constraints.txt -e '.[networks]'")


def test_a_run_needs_none_of_its_packages(tmp_path: Path) -> None:
    write_phantom(PhantomSpec(scene="tube", frames=3, width=96, height=80), tmp_path / "phantom")
    evaluation = ["evaluate", "result", "--truth", "phantom"]
    for command in (["run", "phantom", "--out", "result"], evaluation, ["models", "list"]):
        done = subprocess.run(
            [sys.executable, "-c", COMMAND, *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "result" / "mesh.ply").is_file()
    for line in ("scopenet", "dis", "structure"):
        assert f'"{line}"' in (tmp_path / "result" / "provenance.json").read_text()
