"""A damaged file of a result ends each command that reads it in one sentence."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import read_mesh
from tests.support.drawn_run import draw_run
from tests.support.front_door import refused


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    known = {"known": True, "source": "measured depth", "measured": True}
    return draw_run(tmp_path_factory.mktemp("drawn") / "run", scale=known)


def _body(content: bytearray) -> int:
    return content.index(b"end_header\n") + len(b"end_header\n")


def _face_of_nothing(content: bytearray) -> None:
    content[-4:] = (10**6).to_bytes(4, "little")


def _vertex_nowhere(content: bytearray) -> None:
    content[_body(content) : _body(content) + 4] = np.float32("nan").tobytes()


def _no_header(content: bytearray) -> None:
    content[:64] = bytes(64)


def _cut(content: bytearray) -> None:
    del content[_body(content) + 1000 :]


@pytest.mark.parametrize("damage", [_face_of_nothing, _vertex_nowhere, _no_header, _cut])
def test_a_damaged_surface(
    damage: Callable[[bytearray], None], whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(whole, tmp_path / "run")
    content = bytearray((run / "mesh.ply").read_bytes())
    damage(content)
    (run / "mesh.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"cannot read .*mesh\.ply"):
        read_mesh(run / "mesh.ply")
    assert "mesh.ply" in refused(capfd, "measure", run, "--frame", 3, "--points", "30,20 50,40")
    assert "mesh.ply" in refused(capfd, "export", run, "--to", "ply", "--out", tmp_path / "a.ply")
    assert "mesh.ply" in refused(capfd, "climb", run, "--out", tmp_path / "climb")


@pytest.mark.parametrize("facts", [{"fx": 0}, {"fx": float("nan")}, {"width": -3}, {"height": 10**9}, {"cx": "left"}])
def test_a_damaged_camera(
    facts: dict[str, object], whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(whole, tmp_path / "run")
    provenance = json.loads((run / "provenance.json").read_text())
    provenance["camera"] |= facts
    (run / "provenance.json").write_text(json.dumps(provenance))
    assert "does not state the camera" in refused(capfd, "measure", run, "--frame", 3, "--points", "30,20 50,40")
    assert "does not state the camera" in refused(capfd, "export", run, "--to", "colmap", "--out", tmp_path / "colmap")


def test_a_damaged_sigma_of_the_focal_length(whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = shutil.copytree(whole, tmp_path / "run")
    provenance = json.loads((run / "provenance.json").read_text())
    provenance["camera"]["focal_sigma_px"] = "much"
    (run / "provenance.json").write_text(json.dumps(provenance))
    assert "provenance.json" in refused(capfd, "measure", run, "--frame", 3, "--points", "30,20 50,40")
