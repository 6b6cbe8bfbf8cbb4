"""A surface that is empty, or hardly there: every command and export ends in a result, or in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap import Result
from scopemap.apps.export.formats import FORMATS
from scopemap.engine.fusion.finish import finished, with_normals_alone
from tests.support.drawn_run import changed, draw_run, drawn_result
from tests.support.front_door import call


def _surface(vertices: int, faces: int) -> trimesh.Trimesh:
    points = np.array([[0, 0, 20], [8, 0, 20], [0, 8, 20.0]])[:vertices]
    attributes = {name: np.full(vertices, 0.5, np.float32) for name in ("confidence", "moving", "sigma_mm")}
    return trimesh.Trimesh(
        points.reshape(-1, 3),
        np.array([[0, 2, 1]])[:faces],
        vertex_colors=np.full((vertices, 3), 128, np.uint8),
        vertex_attributes=attributes,
        process=False,
    )


SURFACES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "nothing": trimesh.Trimesh,
    "no vertex": lambda: _surface(0, 0),
    "vertices alone": lambda: _surface(3, 0),
    "a triangle": lambda: _surface(3, 1),
}
COMMANDS = {
    "report": ("report", "RUN"),
    "turntable": ("view", "RUN", "--turntable", "OUT/a.mp4"),
    "coverage": ("coverage", "RUN", "--out", "OUT/c"),
    "measure": ("measure", "RUN", "--frame", 2, "--points", "20,20 40,40", "--reference", "30,20 48,20"),
    "compare": ("compare", "RUN", "RUN", "--out", "OUT/d"),
    "compare-exams": ("compare-exams", "RUN", "RUN", "--out", "OUT/e"),
    "evaluate": ("evaluate", "RUN", "--truth", "RUN"),
    "verify": ("verify", "RUN"),
    **{
        f"export {name}": ("export", "RUN", "--to", name, "--out", f"OUT/a{form.ending}")
        for name, form in FORMATS.items()
    },
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run by the name of its surface."""
    folder, found = tmp_path_factory.mktemp("runs"), {}
    for name, surface in SURFACES.items():
        found[name] = draw_run(folder / name.replace(" ", "-"))
        changed(drawn_result(), mesh=surface()).save(found[name])
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("short_films")
@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_ends_well(
    command: str, surface: str, runs: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(a).replace("RUN", str(runs[surface])).replace("OUT", str(tmp_path)) for a in COMMANDS[command]]
    code, said = call(*arguments), capfd.readouterr()
    assert code in (0, 1), said.err
    if code:
        *warnings, last = said.err.splitlines()
        assert last.startswith("scopemap: ")
        assert all(line.startswith("warning: ") for line in warnings)


@pytest.mark.parametrize("surface", SURFACES)
def test_what_fusion_leaves_is_finished_saved_and_read(surface: str, tmp_path: Path) -> None:
    result = drawn_result()
    mesh = with_normals_alone(finished(SURFACES[surface](), result.config.fusion))
    changed(result, mesh=mesh).save(tmp_path)
    read = Result(tmp_path)
    assert len(read.mesh.faces) == len(mesh.faces) == (surface == "a triangle")
    assert len(read.mesh_at(3).faces) == len(mesh.faces)
