"""The phantom's folder: C3VD layout, readable calibration, truth that survives the files, nothing overwritten."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import typer
from typer.testing import CliRunner

from scopemap.engine.errors import InputError, SettingsError
from scopemap_bench.cli.phantom import phantom as phantom_command
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import encode_depth, write_phantom

SPEC = PhantomSpec(frames=3, width=64, height=48, deform=True, breath_frames=4.0, seed=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "out"
    done: list[tuple[int, int]] = []
    write_phantom(SPEC, folder, lambda n, total: done.append((n, total)))
    assert done == [(1, 3), (2, 3), (3, 3)]
    return folder


def test_layout(folder: Path) -> None:
    frames = [f"{i:04d}_{kind}" for i in range(3) for kind in ("color.png", "depth.tiff")]
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        [*frames, "pose.txt", "camera.yaml", "mesh_truth", "mesh_truth.ply", "phantom.json", "displacement_truth.npz"]
    )
    assert sorted(p.name for p in (folder / "mesh_truth").iterdir()) == ["0000.ply", "0001.ply", "0002.ply"]


def test_files_hold_what_was_rendered(folder: Path) -> None:
    phantom = prepare(SPEC)
    rgb, surface = render_frame(phantom, 1)
    depth = surface.depth_mm
    colour = cv2.imread(str(folder / "0001_color.png"))[..., ::-1]
    np.testing.assert_array_equal(colour, rgb)
    stored = cv2.imread(str(folder / "0001_depth.tiff"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    known = (stored > 0) & (stored < 65535)
    assert known.mean() > 0.9
    assert np.abs(stored[known] * SPEC.depth_scale_mm - depth[known]).max() <= 0.5001 * SPEC.depth_scale_mm + 1e-5
    assert (depth[stored == 65535] >= 65534 * SPEC.depth_scale_mm).all()


def test_pose_file_is_in_the_stored_form(folder: Path) -> None:
    stored = np.loadtxt(folder / "pose.txt", delimiter=",").reshape(-1, 4, 4)
    np.testing.assert_allclose(stored[:, :3, 3], 0, atol=1e-12)
    np.testing.assert_allclose(stored.transpose(0, 2, 1), prepare(SPEC).poses, atol=1e-6)
    assert np.abs(stored[1:, 3, :3]).max() > 0.1


def test_meshes_lie_under_the_depth(folder: Path) -> None:
    phantom = prepare(SPEC)
    rest = trimesh.load(folder / "mesh_truth.ply", process=False)
    moved = trimesh.load(folder / "mesh_truth" / "0002.ply", process=False)
    assert np.abs(phantom.volume.values_at(np.asarray(rest.vertices))[0]).max() < 1e-3
    shift = np.asarray(moved.vertices) - np.asarray(rest.vertices)
    np.testing.assert_allclose(shift, phantom.motion.at(2).at(np.asarray(moved.vertices)), atol=1e-4)
    assert np.linalg.norm(shift, axis=1).max() > 0.5


@pytest.mark.slow
def test_same_spec_writes_the_same_bytes_over_an_earlier_phantom(folder: Path, tmp_path: Path) -> None:
    write_phantom(PhantomSpec(frames=5, width=32, height=32), tmp_path / "again")
    write_phantom(SPEC, tmp_path / "again")
    ours = {p.relative_to(folder) for p in folder.rglob("*") if p.is_file()}
    assert ours == {p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file()}
    for name in ours:
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds other files"):
        write_phantom(SPEC, tmp_path)
    with pytest.raises(InputError, match="it is a file"):
        write_phantom(SPEC, tmp_path / "thesis.tex")
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_depth_codes() -> None:
    depth = np.array([[np.nan, 1e-9, 50.0, 100.0, 250.0]], np.float32)
    np.testing.assert_array_equal(encode_depth(depth, 100 / 65535), [[0, 1, 32768, 65535, 65535]])


@pytest.mark.parametrize("text", ["fog:1-2", "black:1", "black:a-b", "blur:9-3", "smoke:1-2;blur:3-4", "black:-1-2"])
def test_bad_events_name_the_culprit(text: str) -> None:
    with pytest.raises(SettingsError, match=re.escape(f"'{text}'")):
        parse_events(text)


@pytest.mark.parametrize(
    "settings",
    [{"frames": 0}, {"fov_deg": 170}, {"scene": "moon"}, {"breath_mm": 9}, {"shutter": 1.5}, {"h264_crf": 52}],
)
def test_impossible_specs_are_refused(settings: dict) -> None:
    with pytest.raises(SettingsError, match=next(iter(settings))):
        PhantomSpec(**settings)


def run_command(*arguments: str) -> object:
    app = typer.Typer()
    app.command()(phantom_command)
    return CliRunner().invoke(app, list(arguments))


def test_command_writes_and_tells(tmp_path: Path) -> None:
    out = str(tmp_path / "p")
    result = run_command(out, "--frames", "2", "--size", "48x32", "--set", "fov_deg=60", "--scene", "tube", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert (told["frames"], told["spec"]["scene"], told["spec"]["fov_deg"]) == (2, "tube", 60.0)
    again = run_command(out, "--frames", "2", "--size", "48x32", "--quiet")
    assert (again.exit_code, again.output) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--size", "48"], "WIDTHxHEIGHT"),
        (["--set", "fov"], "KEY=VALUE"),
        (["--set", "fog=1"], "unknown phantom setting 'fog'"),
        (["--set", "fov_deg=wide"], "cannot use 'wide'"),
    ],
)
def test_command_refuses_nonsense(tmp_path: Path, arguments: list[str], says: str) -> None:
    result = run_command(str(tmp_path / "p"), *arguments)
    assert isinstance(result.exception, SettingsError)
    assert says in str(result.exception)
    assert not (tmp_path / "p").exists()
