"""COLMAP as a method of the benchmark, by the real pycolmap; skips where that is not installed."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from scopemap.engine.errors import InputError
from scopemap.evaluation.doubts import evaluate_poses
from scopemap.input.opening import open_sequence
from scopemap_bench.methods.method import create_method
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from scopemap_bench.plan import MethodPlan
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

COLMAP = MethodPlan(name="COLMAP", use="colmap")


def test_colmap_finds_the_path_of_a_phantom_up_to_its_scale(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    write_phantom(PhantomSpec(frames=40, seed=3), tmp_path / "phantom")
    method = create_method(COLMAP, None)
    assert method.missing({}) == ""
    times = method.run(open_sequence(tmp_path / "phantom"), {}, tmp_path / "run")
    poses = evaluate_poses(tmp_path / "run", tmp_path / "phantom", "sim3")
    assert poses["tracked"] > 30
    assert poses["ate_rmse_mm"] < 0.2
    parts_s = sum(times[f"seconds_{part}"] for part in ("features", "matches", "mapping"))
    assert times["ms_per_frame"] == pytest.approx(1e3 * parts_s / 40)


def test_a_video_that_colmap_makes_no_model_of_is_a_failed_row(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    for image in sorted(write_tiny(tmp_path / "phantom").glob("*_color.png")):
        cv2.imwrite(str(image), cv2.blur(cv2.imread(str(image)), (41, 41)))  # nothing to match, whatever RANSAC draws
    sequence = open_sequence(tmp_path / "phantom")
    with pytest.raises(InputError, match="COLMAP found no model in the 9 frames of "):
        create_method(COLMAP, None).run(sequence, {}, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_without_pycolmap_the_row_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap_bench.methods.colmap.find_spec", lambda name: None)
    assert (
        create_method(COLMAP, None).missing({}) == "needs pycolmap: pip install -c constraints.txt -e './bench[colmap]'"
    )
