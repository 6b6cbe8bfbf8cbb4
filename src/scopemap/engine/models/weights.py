"""Weights that scopemap knows (`checkpoints.toml`, `weights.lock.json`): folder, hashes, download."""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from scopemap.engine.errors import WeightsError, reporting
from scopemap.engine.models.device import need_packages

Availability = Literal["present", "by hand", "missing", "damaged"]
LOCK_NAME = "weights.lock.json"
_CONFIGURATION = ("config.json", "preprocessor_config.json")


@dataclass(frozen=True)
class Checkpoint:
    """One set of weights that scopemap can use.

    Attributes
    ----------
    name, purpose, licence : what the user calls it, what it is in a few words, the weights' licence.
    size_mb : size on disk, MB; 0 = unknown.
    place : file or folder, below the weights folder.
    source, location : the Hugging Face hub and a repository, torchvision and its name of the weights, or where to fetch
        them by hand.
    files : file below the weights folder to its SHA-256 or that hash's leading digits (torchvision states eight);
        empty = recorded when pulled.
    revision : commit of the hub repository; "" = the newest at the first pull, recorded then (the user's own choices).
    """

    name: str
    purpose: str
    licence: str
    size_mb: float
    place: str
    source: Literal["hub", "torchvision", "hand"]
    location: str
    files: Mapping[str, str] = field(default_factory=dict)
    revision: str = ""


_TABLE = tomllib.loads(Path(__file__).with_name("checkpoints.toml").read_text(encoding="utf-8"))
REGISTRY: dict[str, Checkpoint] = {name: Checkpoint(name, **entry) for name, entry in _TABLE.items()}


def find(name: str) -> Checkpoint:
    """Return the checkpoint of a registered name or of any hub repository ("owner/model").

    A repository that is not registered has no pinned hash: revision and hashes are recorded at its first pull.
    Raises `WeightsError` for anything else.
    """
    for checkpoint in REGISTRY.values():
        if name in (checkpoint.name, checkpoint.location):
            return checkpoint
    owner, _, model = name.partition("/")
    if owner.strip(".") and model.strip(".") and "/" not in model:
        place = f"{owner}--{model}"
        return Checkpoint(name, "chosen by the user", "see its model card", 0.0, place, "hub", name)
    known = ", ".join(REGISTRY)
    raise WeightsError(f"unknown weights '{name}': choose one of {known}, a hub id, or a local folder")


def weights_folder() -> Path:
    """Return the folder of all weights: `SCOPEMAP_WEIGHTS_DIR`, else `scopemap` in the user's cache."""
    if chosen := os.environ.get("SCOPEMAP_WEIGHTS_DIR"):
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "scopemap"


def is_present(*names: str) -> bool:
    """Return whether the files of any of `names` are there, by their names alone."""
    return any(_is_there(find(name)) for name in names)


def fault(*names: str) -> str:
    """Return "" where `locate` finds one of `names`, else the name of what is missing, or "NAME (damaged)"."""
    there = next((one for one in map(find, names) if _is_there(one)), None)
    if there is None:
        return names[0]
    return f"{there.name} (damaged)" if _availability(there) == "damaged" else ""


def locate(*names: str) -> Path:
    """Return the checked file or folder of the first of `names` that is there, no download; raises `WeightsError`."""
    for checkpoint in map(find, names):
        if _is_there(checkpoint):
            return _checked(checkpoint)
    raise WeightsError(_advice(*names))


def verify(name: str) -> Path:
    """Hash every file of `name` again and return its place; raises `WeightsError` if one is missing or damaged."""
    _hash.cache_clear()
    return locate(name)


def overview() -> list[tuple[Checkpoint, Availability]]:
    """Return every registered checkpoint and every other one that was pulled, and whether its files are there."""
    return [(one, _availability(one)) for one in map(find, dict.fromkeys([*REGISTRY, *_read_lock()]))]


def pull(name: str, *, progress: bool = False) -> Path:
    """Download the weights `name`, check and record them, and return their place; known files are only checked.

    Raises `WeightsError` if they can only be fetched by hand, if `HF_HUB_OFFLINE` forbids the network, if the download
    fails, or if what came is not what is pinned.
    """
    checkpoint = find(name)
    if _is_there(checkpoint) and not _is_by_hand(checkpoint):
        return verify(name)
    if checkpoint.source == "hand":
        raise WeightsError(_advice(name))
    if os.environ.get("HF_HUB_OFFLINE", "").upper() in {"1", "ON", "YES", "TRUE"}:
        raise WeightsError(f"cannot pull '{name}' while HF_HUB_OFFLINE is set: unset it")
    download = _download_from_hub if checkpoint.source == "hub" else _download_from_torchvision
    # The clients raise the errors of half a dozen libraries.
    with reporting(f"cannot pull '{name}' from {checkpoint.location}", kind=WeightsError):
        weights_folder().mkdir(parents=True, exist_ok=True)
        revision = download(checkpoint, progress)
    _record(checkpoint, revision)
    return _checked(checkpoint)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits; computed once per process for an unchanged file."""
    stat = path.stat()
    return _hash(str(path), stat.st_size, stat.st_mtime_ns)


def recorded_revision(name: str) -> str:
    """Return the commit of the weights `name`, by their hashes or as they were pulled; "" where unknown."""
    checkpoint = find(name)
    of_hashes = checkpoint.revision if checkpoint.files else ""
    return _read_lock().get(checkpoint.name, {}).get("revision", "") or of_hashes


@lru_cache(maxsize=64)
def _hash(path: str, size: int, mtime_ns: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _expected(checkpoint: Checkpoint) -> dict[str, list[str]]:
    """Return file -> the hashes (or leading digits) that it must have: pinned here, recorded at the pull, or both."""
    recorded = _read_lock().get(checkpoint.name, {}).get("files", {})
    files = checkpoint.files or recorded
    return {file: [checkpoint.files.get(file, ""), recorded.get(file, {}).get("sha256", "")] for file in files}


def _is_there(checkpoint: Checkpoint) -> bool:
    expected = _expected(checkpoint)
    if not expected:
        return _is_by_hand(checkpoint)
    return all((weights_folder() / file).is_file() for file in expected)


def _is_by_hand(checkpoint: Checkpoint) -> bool:
    """Return whether a model of the hub without known hashes is in its folder."""
    if checkpoint.source != "hub" or _expected(checkpoint):
        return False
    place = weights_folder() / checkpoint.place
    return all((place / file).is_file() for file in _CONFIGURATION) and any(place.glob("*.safetensors"))


def _checked(checkpoint: Checkpoint) -> Path:
    for file, hashes in _expected(checkpoint).items():
        path = weights_folder() / file
        found = sha256_of(path)
        if not all(found.startswith(wanted) for wanted in hashes):
            raise WeightsError(
                f"the weights of '{checkpoint.name}' are damaged or of another version: {path} has SHA-256 {found}, "
                f"expected {' and '.join(filter(None, hashes))}. Delete the file and {_how_to_fetch(checkpoint)}"
            )
    return weights_folder() / checkpoint.place


def _availability(checkpoint: Checkpoint) -> Availability:
    if not _is_there(checkpoint):
        return "missing"
    with suppress(WeightsError):
        _checked(checkpoint)
        return "by hand" if _is_by_hand(checkpoint) else "present"
    return "damaged"


def _advice(*names: str) -> str:
    ways = "; or ".join(_how_to_fetch(find(name)) for name in names)
    return f"the weights of '{find(names[0]).name}' are not in {weights_folder()}: {ways}"


def _how_to_fetch(checkpoint: Checkpoint) -> str:
    if checkpoint.source == "hand":
        return f"put {checkpoint.place} there, {checkpoint.licence}, to be found {checkpoint.location}"
    size = f"{checkpoint.size_mb:.0f} MB, " if checkpoint.size_mb else ""
    command = f"run `scopemap models pull {checkpoint.name}` ({size}licence: {checkpoint.licence})"
    if checkpoint.source != "hub":
        return command
    return (
        f"{command}, or copy {', '.join(_CONFIGURATION)} and *.safetensors of {checkpoint.location} to "
        f"{weights_folder() / checkpoint.place}, or name a local folder that holds them (depth.model; for the anchor "
        "depth.anchor_model)"
    )


def _download_from_torchvision(checkpoint: Checkpoint, progress: bool) -> str:
    need_packages(f"pulling {checkpoint.name}", "torch", "torchvision")
    import torch
    import torchvision

    url = torchvision.models.get_weight(checkpoint.location).url
    path = weights_folder() / checkpoint.place
    torch.hub.download_url_to_file(url, str(path), hash_prefix=checkpoint.files[checkpoint.place], progress=progress)
    return ""


def _download_from_hub(checkpoint: Checkpoint, progress: bool) -> str:
    """Download a repository's configuration and safetensors and return the commit they came from."""
    need_packages(f"pulling {checkpoint.name}", "huggingface_hub")
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.utils import disable_progress_bars, enable_progress_bars

    (enable_progress_bars if progress else disable_progress_bars)()
    commit = checkpoint.revision or HfApi().model_info(checkpoint.location).sha
    wanted = [*_CONFIGURATION, "*.safetensors", "*.safetensors.index.json"]
    place = weights_folder() / checkpoint.place
    snapshot_download(checkpoint.location, revision=commit, local_dir=place, allow_patterns=wanted)
    return commit or ""


def _record(checkpoint: Checkpoint, revision: str) -> None:
    folder, place = weights_folder(), weights_folder() / checkpoint.place
    below = [path for path in place.rglob("*") if path.suffix in {".json", ".safetensors"}]
    found = [path for path in below if ".cache" not in path.parts] if place.is_dir() else [place]
    if checkpoint.source == "hub" and not any(path.suffix == ".safetensors" for path in found):
        raise WeightsError(
            f"'{checkpoint.location}' holds no safetensors, and other formats are not loaded: use another"
        )
    files = {path.relative_to(folder).as_posix(): {"sha256": sha256_of(path)} for path in sorted(found)}
    lock = _read_lock() | {checkpoint.name: {"revision": revision, "files": files}}
    draft = folder / f"{LOCK_NAME}.part"
    draft.write_text(json.dumps(lock, indent=2) + "\n", encoding="utf-8")
    draft.replace(folder / LOCK_NAME)


def _read_lock() -> dict[str, Any]:
    path = weights_folder() / LOCK_NAME
    with reporting(f"cannot read the record of pulled weights {path}; delete it and pull again", kind=WeightsError):
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
