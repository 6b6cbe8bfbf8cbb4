"""The weights that scopemap knows (`checkpoints.toml`): where they come from, their licence and their hash."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from scopemap.errors import WeightsError


@dataclass(frozen=True)
class Checkpoint:
    """One set of weights that scopemap can use.

    Attributes
    ----------
    name : what the user calls it.
    purpose : what it is, in a few words.
    licence : licence of the weights.
    size_mb : size on disk, MB; 0 = unknown.
    place : file or folder, below the weights folder.
    source : where it comes from: the Hugging Face hub, torchvision's weights enums, or by hand.
    location : hub repository, torchvision's name of the weights, or where to fetch them by hand.
    files : file below the weights folder to its SHA-256 or that hash's leading digits; empty = recorded when pulled.
        torchvision puts the first eight digits of the hash into the file's name.
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


_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
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
