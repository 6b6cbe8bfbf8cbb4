"""`--memory`: what a run may hold, a refusal that names the least, and a surface of coarser voxels that is as true."""

from __future__ import annotations

import ctypes
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap import open_sequence
from scopemap.engine.config import Config, FusionSettings
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.surface_fusion import SurfaceFusion
from scopemap.engine.fusion.tsdf import pack
from scopemap.engine.fusion.voxel_blocks import VoxelBlocks, dense
from scopemap.engine.mapping.mapper import MOST_OBSERVATIONS
from scopemap.runner.memory import MemoryPlan, memory_plan
from scopemap.runner.network_cost import network_cost
from tests.support.drawn_surfaces import all_around, sphere_frame
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import SIZE, write_tiny

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


def _plan(folder: Path, memory_mb: int | None, size: tuple[int, int] = SIZE, **settings: object) -> MemoryPlan:
    given = {"run.memory_mb": memory_mb} | {key.replace("__", "."): value for key, value in settings.items()}
    return memory_plan(Config.load(settings=given), open_sequence(folder, size=size))


def test_more_memory_is_more_of_everything_up_to_what_is_used_without_a_limit(folder: Path) -> None:
    assert _plan(folder, None) == MemoryPlan(blocks=None)
    plans = [_plan(folder, memory_mb) for memory_mb in (800, 1000, 4000)]
    assert [plan.blocks for plan in plans] == sorted({plan.blocks for plan in plans})
    assert plans[0].observations < plans[2].observations == MOST_OBSERVATIONS
    large = _plan(folder, 4000, (640, 512))
    assert plans[2].blocks is not None
    assert large.blocks < plans[2].blocks


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="glibc's malloc is not used here")
def test_after_the_last_frame_large_arrays_are_given_back() -> None:
    code = """
import sys
from pathlib import Path
import numpy as np
from scopemap.runner.memory import keep_freed_arrays

keep_freed_arrays(at_the_end=sys.argv[1] == "end")
arrays = [np.ones(2**21, np.uint8) for _ in range(60)]
del arrays[:-1]  # the last one is above the others, so that none of their memory is at the end of the heap
print(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6)
"""

    def held_mb(when: str) -> float:
        return float(subprocess.run([sys.executable, "-c", code, when], capture_output=True, check=True).stdout)

    assert held_mb("tracking") - held_mb("end") > 100  # of 124


def test_too_little_is_refused_with_the_least_that_works_before_anything_is_written(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ask = ("run", folder, "--out", tmp_path / "new" / "out", "--quiet", "--memory", "100MB")
    said = refused(capfd, *ask)
    assert "MB are the least for 9 frames of 160x128 px" in said
    assert list(tmp_path.iterdir()) == []
    least = int(re.search(r"(\d+) MB are the least", said)[1])
    assert _plan(folder, least).ahead == 1
    with pytest.raises(InputError, match=f"{least} MB are the least"):
        _plan(folder, least - 1)


def test_networks_whose_memory_is_not_known_are_refused(folder: Path) -> None:
    with pytest.raises(SettingsError, match=r"cannot be guaranteed with depth-anything, raft-small"):
        _plan(folder, 4000, depth__backend="depth-anything", networks__flow="raft-small")


def test_a_halved_field_holds_every_second_voxel() -> None:
    blocks, rng = VoxelBlocks(), np.random.default_rng(0)
    keys = np.unique(np.asarray(pack.py_func(*rng.integers(-20, 20, (500, 3)).T)))
    slots = blocks.slots(keys)
    for array in blocks.voxels:
        array[slots] = rng.random(array[slots].shape)
    before, slots = blocks.voxels, blocks.box(np.full(3, -20), np.full(3, 40))
    blocks.halve()
    halved = blocks.box(np.full(3, -10), np.full(3, 20))
    for finer, coarser in zip(before, blocks.voxels, strict=True):
        np.testing.assert_array_equal(dense(finer[slots])[::2, ::2, ::2], dense(coarser[halved]))


@pytest.mark.parametrize("at_end", [True, False])
def test_voxels_grow_until_the_surface_is_within_the_limit(at_end: bool, tmp_path: Path) -> None:
    settings = FusionSettings(voxel_mm=0.5, max_depth_mm=150.0)
    frames = [replace(sphere_frame(T, 30.0), index=n) for n, T in enumerate(all_around())]
    meshes, counts = [], []
    for limit in (None, 2500, 200):
        fusion = SurfaceFusion(settings, FrameStore(tmp_path), corrected=at_end)
        fusion.coarser_beyond = limit
        for frame in frames:
            fusion.put(frame)
        found = fusion.fuse(fusion.store.frames(), fusion.store.median_depth_mm({0}))
        meshes.append(found.mesh)
        counts.append((found.settings.voxel_mm, found.settings.truncation_mm, len(found.notices)))
    assert counts == [(0.5, 2.5, 0), (1.0, 5.0, 1), (4.0, 20.0, 1)] or counts[1][0] == 1.0 < counts[2][0]
    assert len(meshes[0].faces) > 3 * len(meshes[1].faces) > 9 * len(meshes[2].faces)
    for mesh, tolerance_mm in zip(meshes, (0.1, 0.2, 1.5), strict=True):
        radius_mm = np.linalg.norm(mesh.vertices, axis=1)
        assert np.median(np.abs(radius_mm - 30.0)) < tolerance_mm


def _codes(run: Path) -> set[str]:
    return {notice["code"] for notice in json.loads((run / "provenance.json").read_text())["notices"]}


def test_a_limited_run_says_what_was_chosen_and_its_settings_repeat_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scopemap.runner.memory._BLOCK_BYTES", 500_000)
    monkeypatch.setattr("scopemap.runner.memory._LEAST_BLOCKS", 100)
    ask = ("run", folder, "--depth", f"files:{folder}")
    assert call(*ask, "--out", tmp_path / "free") == 0
    assert "memory-limited" not in _codes(tmp_path / "free")
    assert call(*ask, "--out", tmp_path / "limited", "--memory", "800MB") == 0
    assert {"memory-limited", "fusion-coarsened"} <= _codes(tmp_path / "limited")
    assert "memory_mb = 800" in (tmp_path / "limited" / "config.toml").read_text()
    faces = [len(trimesh.load_mesh(tmp_path / name / "mesh.ply").faces) for name in ("free", "limited")]
    assert faces[0] > 2 * faces[1] > 200


def test_what_networks_cost_is_said_before_the_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    strict, sequence = Config.load("paper-strict", settings={"networks.device": "cpu"}), open_sequence(folder)
    large = open_sequence(folder, size=(1350, 1080))
    said = network_cost(strict, large)
    assert said.startswith("cost of depth-anything, depth-pro, lpips, raft-large at 1350x1080 px on 2 core(s): about 3")
    small = network_cost(strict, sequence)
    seconds, gigabytes = (
        [float(re.search(rf"([\d.]+) {unit}", text)[1]) for text in (small, said)] for unit in ("s a frame", "GB of m")
    )
    assert seconds[1] > 10 * seconds[0]
    assert gigabytes[1] - gigabytes[0] > 2.7  # the correlations of all pairs
    checked = network_cost(Config.load("paper", settings={"networks.device": "cpu"}), large)
    assert float(re.search(r"([\d.]+) s a", checked)[1]) > 1.8 * seconds[1]  # flow both ways
    monkeypatch.setattr("scopemap.runner.network_cost._available_gb", lambda: 1.0)
    assert "of 1.0 GB that are free. That is not enough." in network_cost(strict, sequence)
    assert network_cost(Config(), sequence) == ""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(folder / "none"))
    asked = ("run", folder, "--out", folder.parent / "out", "--flow", "raft-small")
    assert call(*asked) == 1
    assert "cost of" not in capfd.readouterr().err  # without its weights nothing will run
    monkeypatch.setattr("scopemap.runner.estimators.missing_weights", lambda config: [])
    assert call(*asked) == 1
    assert capfd.readouterr().err.startswith("cost of raft-small at 160x128 px")
