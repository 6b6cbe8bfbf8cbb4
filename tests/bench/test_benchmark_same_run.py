"""A plan's row "scopemap" is the program that `scopemap run` runs: with the same settings it writes the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

from scopemap_bench.entry import Entry
from scopemap_bench.plan import MethodPlan, ProtocolPlan, SequencePlan
from scopemap_bench.runner import run_entry
from tests.support.front_door import call
from tests.support.small_networks import saved, small_depth_anything, use_weights, write_weights
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.networks

FRAMES = 6
# Without weights for them: flow by DIS, and structural similarity.
WITHOUT = {"networks.flow": "dis", "networks.perceptual": "structure"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_tiny(folder / "clip", frames=FRAMES)
    write_weights(folder / "weights")
    saved(small_depth_anything(), folder / "depth-anything")
    return folder


@pytest.mark.parametrize(
    ("preset", "settings"),
    [
        (None, {}),
        ("realtime", {}),
        (None, {"mapping.method": "none"}),
        ("paper", {"depth.model": "depth-anything"}),
    ],
    ids=["default", "realtime", "no back end", "paper"],
)
def test_a_row_writes_the_bytes_of_a_run(
    preset: str | None, settings: dict[str, str], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_weights(data / "weights", monkeypatch)
    monkeypatch.chdir(data)
    chosen = WITHOUT | settings
    method = MethodPlan.model_validate({"name": "scopemap", "preset": preset, "settings": chosen})
    sequence = SequencePlan(name="clip", path="clip")
    entry = Entry(
        sequence=sequence, method=method, protocol=ProtocolPlan(), settings={}, seed=0, data=data, out=tmp_path
    )
    row = run_entry(entry)
    assert (row.status, row.error) == ("done", "")
    options = [text for name, value in chosen.items() for text in ("--set", f"{name}={value}")]
    options += ["--preset", preset] if preset else []
    assert call("run", data / "clip", "--out", tmp_path / "run", "--quiet", *options) == 0
    compared = [bytes_of(folder) for folder in (entry.run_folder, tmp_path / "run")]
    assert {"trajectory.tum", "frames.csv", "mesh.ply", "config.toml"} <= set(compared[0])
    assert sum(name.startswith("depth/") for name in compared[0]) > FRAMES
    assert compared[0] == compared[1]


def bytes_of(folder: Path) -> dict[str, bytes]:
    """The files of a run, but those that hold its times, and the report, which the command adds."""
    names = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
    left_out = ("provenance.json", "SHA256SUMS", "report.html", "summary.png", "frames/")
    return {name: (folder / name).read_bytes() for name in names if not name.startswith(left_out)}
