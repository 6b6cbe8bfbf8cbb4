"""The page that follows the paper is what `paper-strict` computes; the presets' keyframes are the paper's."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.odometry import Step
from scopemap.runner.estimators import create_estimators
from tests.support.places import ROOT
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

FILE = ROOT / "examples" / "05_the_paper_frame_by_frame.py"
EQUATIONS = 13
MOST_LINES = 155


def page() -> ModuleType:
    spec = importlib.util.spec_from_file_location("paper_frame_by_frame", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def small_networks(folder: Path) -> dict[str, object]:
    pytest.importorskip("torch")
    from tests.support.small_networks import saved, small_depth_anything, small_depth_pro

    models = {"depth.model": saved(small_depth_anything(), folder / "anything")}
    models |= {"depth.anchor_model": saved(small_depth_pro(inverse_depth=300.0), folder / "pro")}
    return {key: str(value) for key, value in models.items()} | {
        "networks.flow": "dis",
        "networks.perceptual": "structure",
    }


@pytest.mark.parametrize("networks", ["stand-ins", "small networks"])
def test_the_page_computes_what_the_preset_does(networks: str, tmp_path: Path) -> None:
    followed, phantom = page(), write_tiny(tmp_path / "phantom")
    by_files = networks == "stand-ins"
    settings = followed.stand_ins(phantom, tmp_path / "disparity") if by_files else small_networks(tmp_path)
    config = Config.load("paper-strict", settings=settings)
    sequence = open_sequence(phantom, settings=config.input)
    frames, volume = followed.paper((frame for frame, _ in sequence), config, create_estimators(config, sequence))
    steps: list[Step] = []
    result = reconstruct(open_sequence(phantom, settings=config.input), config, observers=(steps.append,))
    assert len(frames) == len(steps) > 6
    for frame, step in zip(frames, steps, strict=True):
        # torch sums in another order on one thread, where the run calls it from threads of its own.
        np.testing.assert_allclose(frame.depth_mm, step.frame.depth_mm, rtol=1e-5)
        np.testing.assert_allclose(frame.T_world_camera, step.frame.T_world_camera, atol=1e-9)
    np.testing.assert_allclose([f.T_world_camera for f in frames], result.trajectory.T_world_camera, atol=1e-9)
    assert np.linalg.norm(frames[-1].T_world_camera[:3, 3]) > 0.1  # it moves
    assert abs(len(volume.extract_mesh().faces) / len(result.mesh.faces) - 1) < 0.01


def test_it_is_short_and_names_every_equation() -> None:
    text = FILE.read_text()
    assert text.count("\n") <= MOST_LINES
    comments = " ".join(re.findall("#.*", text))
    assert {int(number) for number in re.findall(r"\((\d+)\)", comments)} == set(range(1, EQUATIONS + 1))


@pytest.mark.parametrize("preset", ["paper", "paper-strict"])
@pytest.mark.parametrize("events", ["", "blur:3-4", "blur:2-6"])
def test_the_keyframes_of_the_preset_are_0_2_4_whatever_the_pictures(preset: str, events: str, tmp_path: Path) -> None:
    """The paper's j = 2 m: no keyframe waits for a clear picture or for motion, and none comes early."""
    phantom = write_tiny(tmp_path / "phantom", events)
    settings = page().stand_ins(phantom, tmp_path / "disparity")
    config = Config.load(preset, settings=settings)  # type: ignore[arg-type]
    steps: list[Step] = []
    result = reconstruct(open_sequence(phantom, settings=config.input), config, observers=(steps.append,))
    assert [step.track.status for step in steps] == ["initial", *["ok"] * (len(steps) - 1)]
    numbers = range(len(steps))
    # Each frame is aligned to the keyframe before it, a keyframe to the one before.
    assert [step.track.keyframe for step in steps] == [0, *(2 * ((number - 1) // 2) for number in numbers[1:])]
    assert result.config.tracking.keyframe_every == 2


@pytest.mark.parametrize(
    ("module", "equations"),
    [("depth.mapis", (2, 3, 4)), ("tracking.rtdl", (5, 6, 7, 9, 10, 12)), ("tracking.smoothing", (13,))],
)
def test_docstrings_name_the_equations(module: str, equations: tuple[int, ...]) -> None:
    text = (FILE.parents[1] / "src/scopemap/engine" / f"{module.replace('.', '/')}.py").read_text()
    assert "arXiv 2508.11282" in text.split('"""')[1]
    # "(7 to 9)" and "(10, 12)" name each.
    assert set(equations) <= {int(number) for number in re.findall(r"\b(\d+)\b", " ".join(text.split('"""')[1::2]))}


def test_code_does_not_cite_what_a_reader_does_not_have() -> None:
    sources = [*(FILE.parents[1] / "src").rglob("*.py"), *(FILE.parents[1] / "bench/src").rglob("*.py")]
    cited = [file.name for file in sources if re.search(r"\bMETHOD('s| section| of)|steps \d-\d", file.read_text())]
    assert cited == []
