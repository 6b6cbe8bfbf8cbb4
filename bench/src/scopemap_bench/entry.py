"""Entry: one method on one sequence with one seed, the unit that a process of its own runs."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from scopemap.engine.config import Config
from scopemap.engine.errors import SettingsError
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.input.source import OWN_CALIBRATION
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from scopemap_bench.plan import MethodPlan, Plan, ProtocolPlan, SequencePlan, folder_name, spec_of

FILE_NAME = "entry.json"


class Entry(BaseModel):
    """One row of a benchmark before it is run: parts of its plan, the folder of --data, and the benchmark's folder."""

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
        """Name of the sequence, with the seed where it is not 0."""
        return self.sequence.name + (f", seed {self.seed}" if self.seed else "")

    @property
    def folder(self) -> Path:
        """Folder of entry.json, result.json and log.txt."""
        return self.out / "runs" / folder_name(self.label) / folder_name(self.method.name)

    @property
    def run_folder(self) -> Path:
        """Folder of the run's own files."""
        return self.folder / "run"

    @property
    def source(self) -> Path:
        """Folder or file of the sequence; a phantom is rendered below `out`."""
        if self.sequence.phantom is not None:
            return self.out / "phantoms" / folder_name(self.label)
        return _below(self.data, self.sequence.path)

    @property
    def flows(self) -> Path:
        """Folder of the flow that all methods of this sequence are measured with."""
        described = self.sequence.model_dump(mode="json", exclude={"figure"})
        return self.out / "flows" / f"{folder_name(self.label)}-{_digest([described])[:8]}"

    @property
    def truths(self) -> Path:
        """Folder of the true depth at the working size that all methods of this sequence are measured with."""
        described = self.sequence.model_dump(mode="json", exclude={"figure"})
        return self.out / "truths" / f"{folder_name(self.label)}-{_digest([described, self.settings, self.inputs])[:8]}"

    @property
    def key(self) -> str:
        """Fingerprint of all that decides the figures but the code: the plan, and size and time of the files in it."""
        described = self.model_dump(mode="json", exclude={"out": True, "data": True, "sequence": {"figure"}})
        if not self.method.files:
            described["method"]["unit"] = "mm"  # of no figure; results of earlier versions were kept under this key
        named = [self.method.files.format(sequence=self.sequence.name, seed=self.seed), self.sequence.camera or ""]
        named += [self.sequence.depth.partition("files:")[2], (self.sequence.phantom or {}).get("path_file", "")]
        stamps = [_stamp(self.data / name) for name in named if name and self.data is not None]
        return _digest([described, stamps, version("scopemap")])[:16]

    @property
    def inputs(self) -> list[list[int]]:
        """Size and time of the sequence's files and of calibrations beside it: where they change, a failure may end."""
        beside = (folder / name for folder in self.source.parents[:3] for name in (OWN_CALIBRATION, "calibration"))
        return [_stamp(path) for path in (self.source, *beside)]

    def open(self) -> Sequence:
        """Open the sequence; raises as `open_sequence`."""
        plan = self.sequence
        return open_sequence(
            self.source,
            dataset=plan.dataset,
            camera=None if plan.camera is None else _below(self.data, plan.camera),
            size=plan.size,
            frames=None if plan.frames is None else slice(*plan.frames),
            settings=Config.load(settings=self.settings | plan.settings).input,
        )

    def shared_settings(self) -> dict[str, Any]:
        """Return the settings that all methods get on this sequence."""
        settings = self.settings | self.sequence.settings
        kind, _, folder = self.sequence.depth.partition(":")
        if kind == "true":
            # C3VDv2 and EndoGSLAM keep depth in a folder of its own; 8-bit true depth is depth, not disparity.
            frames = self.source if self.sequence.phantom is not None else self.open().path
            depth = frames / "depth" if (frames / "depth").is_dir() else frames
            settings |= {"depth.backend": f"files:{depth}", "depth.files_kind": "measured"}
        elif kind == "files":
            settings["depth.backend"] = f"files:{_below(self.data, folder)}"
        elif kind:
            settings["depth.backend"] = self.sequence.depth
        if kind:
            # A preset may ask for a metric network: the plan's depth is used without one.
            settings.setdefault("depth.anchor", "auto")
        if self.sequence.near_far_mm is not None:
            settings |= {"depth.near_far_mm": self.sequence.near_far_mm, "depth.anchor": "near-far"}
        Config.load(settings=settings)
        return settings

    def render_phantom(self) -> None:
        """Render the sequence's phantom, if it is one, unless an earlier entry did."""
        if self.sequence.phantom is not None:
            render_once(spec_of(self.sequence.phantom, self.seed, self.data), self.source)

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
    """Yield the plan's entries, sequence by sequence; further seeds only where something depends on the seed."""
    for sequence in sequences:
        for seed in plan.seeds:
            for method in plan.method:
                if seed == plan.seeds[0] or sequence.phantom is not None or "{seed}" in method.files:
                    of_plan = {"protocol": plan.protocol, "settings": plan.settings, "data": data, "out": out}
                    yield Entry(sequence=sequence, method=method, seed=seed, **of_plan)


def render_once(spec: PhantomSpec, folder: Path, progress: Callable[[int, int], None] | None = None) -> bool:
    """Render a phantom, unless `folder` holds it, complete (its mesh is written last); return whether it was needed."""
    try:
        description = json.loads((folder / "phantom.json").read_text())
    except (OSError, ValueError, RecursionError):
        description = {}
    wanted = json.loads(json.dumps(asdict(spec), default=str))
    same = description.get("spec") == wanted and description.get("made_by") == f"scopemap {version('scopemap')}"
    if same and (folder / "mesh_truth.ply").is_file():
        return False
    write_phantom(spec, folder, progress)
    return True


def _stamp(path: Path) -> list[int]:
    """Return number, size and latest time of a file or of the files below a folder; [] where there is none."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    stats = [file.stat() for file in files]
    return [len(stats), sum(s.st_size for s in stats), max(s.st_mtime_ns for s in stats)] if stats else []


def _digest(tree: Any) -> str:
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()


def _below(data: Path | None, path: str) -> Path:
    if data is None:
        raise SettingsError(f"give --data, the folder of '{path}'")
    return data / path


def worker_command(file: Path) -> list[str]:
    """Return the command that runs the entry in `file`."""
    return [sys.executable, "-m", "scopemap_bench.runner", str(file)]
