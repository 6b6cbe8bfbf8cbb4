"""Entry: one method on one sequence with one seed, as it is handed to a process of its own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from scopemap.benchmark.plan import MethodPlan, Plan, ProtocolPlan, SequencePlan, folder_name, spec_of
from scopemap.config import Config
from scopemap.errors import SettingsError
from scopemap.io.opening import open_sequence
from scopemap.io.sequence import Sequence

FILE_NAME = "entry.json"


class Entry(BaseModel):
    """One row-to-be.

    Attributes
    ----------
    sequence, method, protocol, settings, seed : of the plan. data : the folder that --data names.
    out : the benchmark's folder.
    """

    model_config = ConfigDict(frozen=True)

    sequence: SequencePlan
    method: MethodPlan
    protocol: ProtocolPlan
    settings: dict[str, Any]
    seed: int
    data: Path | None
    out: Path

    @property
    def label(self) -> str:
        """Name for people and, made safe, for folders: the seed stands in it where it is not 0."""
        return self.sequence.name + (f", seed {self.seed}" if self.seed else "")

    @property
    def folder(self) -> Path:
        """Where the run is kept."""
        return self.out / "runs" / folder_name(self.label) / folder_name(self.method.name)

    @property
    def source(self) -> Path:
        """The sequence's own folder or file; a phantom's is made below `out`."""
        if self.sequence.phantom is not None:
            return self.out / "phantoms" / folder_name(self.label)
        return _below(self.data, self.sequence.path)

    @property
    def flows(self) -> Path:
        """Where flow is kept for all methods; a sequence that the plan describes otherwise has another place."""
        return self.out / "flows" / f"{folder_name(self.label)}-{_digest([self.sequence.model_dump(mode='json')])[:8]}"

    @property
    def key(self) -> str:
        """Fingerprint of all that decides the figures but the code: the plan's words, and the files that it names.

        A file or folder stands for its content by its size and time. Another --data with the same files is the same.
        """
        described = self.model_dump(mode="json", exclude={"out", "data"})
        named = [self.method.files.format(sequence=self.sequence.name, seed=self.seed), self.sequence.camera or ""]
        named += [self.sequence.depth.partition("files:")[2], (self.sequence.phantom or {}).get("path_file", "")]
        stamps = [_stamp(self.data / name) for name in named if name and self.data is not None]
        return _digest([described, stamps, version("scopemap")])[:16]

    def open(self) -> Sequence:
        """Open the sequence; raises as `open_sequence`."""
        plan = self.sequence
        camera = None if plan.camera is None else _below(self.data, plan.camera)
        frames = None if plan.frames is None else slice(*plan.frames)
        settings = Config.load(settings=self.settings | plan.settings).input
        return open_sequence(
            self.source, dataset=plan.dataset, camera=camera, size=plan.size, frames=frames, settings=settings
        )

    def shared_settings(self) -> dict[str, Any]:
        """Return the settings that all methods are given on this sequence."""
        settings = self.settings | self.sequence.settings
        kind, _, folder = self.sequence.depth.partition(":")
        if kind == "true":
            # C3VDv2 and EndoGSLAM keep depth apart; 8 bit is depth, too, when it is the truth.
            frames = self.source if self.sequence.phantom is not None else self.open().path
            apart = frames / "depth"
            settings |= {"depth.backend": f"files:{apart if apart.is_dir() else frames}"}
            settings |= {"depth.files_kind": "measured"}
        elif kind == "files":
            settings["depth.backend"] = f"files:{_below(self.data, folder)}"
        elif kind:
            settings["depth.backend"] = self.sequence.depth
        if kind:
            # A preset may ask for a metric network: the depth that a plan names stands for itself.
            settings.setdefault("depth.anchor", "auto")
        if self.sequence.near_far_mm is not None:
            settings |= {"depth.near_far_mm": self.sequence.near_far_mm, "depth.anchor": "near-far"}
        Config.load(settings=settings)
        return settings

    def save(self) -> Path:
        """Write the entry into its folder and return the file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / FILE_NAME
        file.write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        return file

    @classmethod
    def load(cls, file: Path) -> Entry:
        """Read what `save` wrote."""
        return cls.model_validate_json(Path(file).read_text(encoding="utf-8"))


def entries_of(plan: Plan, sequences: list[SequencePlan], data: Path | None, out: Path) -> Iterator[Entry]:
    """Yield the plan's rows, sequence by sequence; seeds beyond the first make sense where something is random."""
    for sequence in sequences:
        for seed in plan.seeds:
            for method in plan.method:
                if seed == plan.seeds[0] or _depends_on_seed(sequence, method):
                    yield Entry(
                        sequence=sequence,
                        method=method,
                        protocol=plan.protocol,
                        settings=plan.settings,
                        seed=seed,
                        data=data,
                        out=out,
                    )


def render_phantom(entry: Entry) -> None:
    """Render the phantom of an entry, unless an earlier row did so."""
    from scopemap.benchmark.demonstration import is_rendered
    from scopemap.phantom import write_phantom

    if entry.sequence.phantom is None:
        return
    spec = spec_of(entry.sequence.phantom, entry.seed, entry.data)
    if not is_rendered(entry.source, spec):
        write_phantom(spec, entry.source)


def _stamp(path: Path) -> list[int]:
    """Return size and time of a file, or number, size and latest time of the files in a folder; [] for neither."""
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
    stats = [file.stat() for file in files]
    return [len(stats), sum(s.st_size for s in stats), max(s.st_mtime_ns for s in stats)] if stats else []


def _digest(tree: Any) -> str:
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()


def _depends_on_seed(sequence: SequencePlan, method: MethodPlan) -> bool:
    return sequence.phantom is not None or "{seed}" in method.files


def _below(data: Path | None, path: str) -> Path:
    if data is None:
        raise SettingsError(f"'{path}' lies below the folder that --data names: give it")
    return data / path
