"""Weights on disk: found, missed, damaged, recorded; nothing is fetched unless asked for."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from scopemap.apps.models import command as models
from scopemap.engine.errors import SettingsError, WeightsError
from scopemap.engine.models import weights
from scopemap.engine.models.device import choose_device
from scopemap.engine.models.weights import REGISTRY, Checkpoint, find

pytestmark = pytest.mark.networks

CONTENT = b"not really a network"
TOY = Checkpoint(
    name="toy",
    purpose="for this test",
    licence="MIT",
    size_mb=0.1,
    place="toy.pth",
    source="torchvision",
    location="Raft_Small_Weights.C_T_V2",
    files={"toy.pth": hashlib.sha256(CONTENT).hexdigest()[:8]},
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty weights folder, one toy checkpoint beside the registered ones, and a network that must not be used."""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setitem(weights.REGISTRY, TOY.name, TOY)
    monkeypatch.setitem(REGISTRY, "toy", TOY)
    monkeypatch.setattr("torch.hub.download_url_to_file", _forbidden)
    monkeypatch.setattr("huggingface_hub.snapshot_download", _forbidden)
    return tmp_path


def _forbidden(*args: object, **kwargs: object) -> None:
    raise AssertionError("something was downloaded that nobody asked for")


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """A hub that serves these files; its newest commit is "c0ffee"."""
    served = {"config.json": b"{}", "model.safetensors": b"weights", "extra/part.safetensors": b"more"}

    def download(repo: str, *, revision: str, local_dir: Path, allow_patterns: list[str]) -> None:
        assert revision == (weights.find(repo).revision or "c0ffee")
        for name, content in served.items():
            path = Path(local_dir) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def model_info(self: object, repo: str) -> SimpleNamespace:
        return SimpleNamespace(sha="c0ffee")

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr("huggingface_hub.HfApi.model_info", model_info)
    return served


def test_missing_weights_say_what_to_do(folder: Path) -> None:
    with pytest.raises(WeightsError, match="scopemap models pull raft-small") as caught:
        weights.locate("raft-small", "raft-small-authors")
    assert str(folder) in str(caught.value)
    assert "raft-small.pth" in str(caught.value)
    with pytest.raises(WeightsError, match=r"scopemap models pull depth-pro.*local folder"):
        weights.locate("depth-pro")


def test_damaged_weights_are_refused(folder: Path) -> None:
    (folder / "toy.pth").write_bytes(CONTENT + b"!")
    with pytest.raises(WeightsError, match=r"damaged.*toy\.pth"):
        weights.locate("toy")
    assert {one.name: state for one, state in weights.overview()}["toy"] == "damaged"


def test_pull_fetches_checks_and_records(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def download(url: str, path: str, hash_prefix: str, progress: bool) -> None:
        asked.append(url)
        Path(path).write_bytes(CONTENT)

    monkeypatch.setattr("torch.hub.download_url_to_file", download)
    assert weights.pull("toy") == folder / "toy.pth"
    assert weights.pull("toy") == folder / "toy.pth"
    assert asked == ["https://download.pytorch.org/models/raft_small_C_T_V2-01064c6d.pth"]
    record = json.loads((folder / weights.LOCK_NAME).read_text())["toy"]["files"]["toy.pth"]
    assert record["sha256"] == hashlib.sha256(CONTENT).hexdigest()


@pytest.mark.parametrize(
    ("name", "revision"),
    [("depth-pro", weights.find("depth-pro").revision), ("someone/their-depth", "c0ffee")],
)
def test_repository_is_held_to_its_first_pull(folder: Path, hub: dict[str, bytes], name: str, revision: str) -> None:
    assert not weights.is_present(name)
    place = weights.pull(name)
    assert weights.recorded_revision(name) == revision
    assert re.fullmatch(r"[0-9a-f]{40}|c0ffee", revision)
    assert name in [one.name for one, _ in weights.overview()]
    assert weights.verify(name) == place
    assert weights.locate(name) == weights.locate(weights.find(name).location) == place
    (place / "model.safetensors").write_bytes(b"WEIGHTS")
    with pytest.raises(WeightsError, match="damaged"):
        weights.locate(name)


def test_a_model_copied_by_hand_is_found_without_a_record(folder: Path) -> None:
    place = folder / "depth-pro"
    place.mkdir()
    for name in ("config.json", "preprocessor_config.json"):
        (place / name).write_text("{}")
    assert not weights.is_present("depth-pro")
    (place / "model.safetensors").write_bytes(b"weights")
    assert weights.locate("depth-pro") == place
    assert {one.name: state for one, state in weights.overview()}["depth-pro"] == "by hand"
    assert weights.recorded_revision("depth-pro") == ""
    said = CliRunner().invoke(models.app, ["verify", "depth-pro", "--json"]).stdout
    assert json.loads(said) == {"depth-pro": "by hand, no hash to check"}


def test_pinned_repository_refuses_other_content(folder: Path, hub: dict[str, bytes]) -> None:
    hub["preprocessor_config.json"] = b"{}"
    with pytest.raises(WeightsError, match="damaged or of another version"):
        weights.pull("depth-anything")
    assert {one.name: state for one, state in weights.overview()}["depth-anything"] == "damaged"


def test_repository_without_safetensors_is_refused(folder: Path, hub: dict[str, bytes]) -> None:
    for name in [name for name in hub if name.endswith("safetensors")]:
        del hub[name]
    with pytest.raises(WeightsError, match="no safetensors"):
        weights.pull("someone/pickles")
    assert not weights.is_present("someone/pickles")


def test_a_pull_that_cannot_be_is_one_clear_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setattr("torch.hub.download_url_to_file", refuse)
    with pytest.raises(WeightsError, match=r"cannot pull 'raft-small'.*no route to host"):
        weights.pull("raft-small")
    with pytest.raises(WeightsError, match=r"put raft-things\.pth there"):
        weights.pull("raft-things")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for name in ("depth-pro", "raft-small"):
        with pytest.raises(WeightsError, match="HF_HUB_OFFLINE"):
            weights.pull(name)


@pytest.mark.parametrize("name", ["raft", "a/b/c", "../x", "", "./"])
def test_unknown_names(name: str) -> None:
    with pytest.raises(WeightsError, match="unknown weights"):
        find(name)


def test_registry_agrees_with_torchvision() -> None:
    torchvision = pytest.importorskip("torchvision", reason="needs the extra networks")

    for checkpoint in REGISTRY.values():
        if checkpoint.source == "torchvision":
            weight = torchvision.models.get_weight(checkpoint.location)
            assert weight.url.endswith("/" + checkpoint.place)
            assert f"-{checkpoint.files[checkpoint.place]}." in weight.url
            assert weight.meta["_file_size"] == pytest.approx(checkpoint.size_mb / 1.048576, rel=0.02)


def test_command_line(folder: Path) -> None:
    (folder / "toy.pth").write_bytes(CONTENT)
    run = CliRunner().invoke
    listed = json.loads(run(models.app, ["list", "--json"]).stdout)
    assert {row["name"]: row["state"] for row in listed}["toy"] == "present"
    assert "raft-things" in run(models.app, ["list"]).stdout
    assert json.loads(run(models.app, ["verify", "--json"]).stdout) == {"toy": "ok"}
    assert json.loads(run(models.app, ["pull", "toy", "--json"]).stdout)["path"] == str(folder / "toy.pth")
    (folder / "toy.pth").write_bytes(b"spoilt")
    assert isinstance(run(models.app, ["verify"]).exception, WeightsError)
    assert isinstance(run(models.app, ["verify", "raft-large"]).exception, WeightsError)
    assert run(models.app, ["list", "--quiet"]).stdout == ""


def test_device_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert choose_device("auto") == "cpu"
    with pytest.raises(SettingsError, match="no CUDA device"):
        choose_device("cuda")
    with pytest.raises(SettingsError, match="unknown device"):
        choose_device("abacus")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert choose_device("auto") == "cuda"
