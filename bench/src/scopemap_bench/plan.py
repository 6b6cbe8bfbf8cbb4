"""Plan of a benchmark: which sequences, which methods, how runs are scored; read from TOML (docs/benchmark.md)."""

from __future__ import annotations

import mimetypes
import os
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import resources
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from scopemap.engine.config import Config, Preset, explain
from scopemap.engine.errors import InputError, ScopemapError, SettingsError
from scopemap.engine.flow.flows import FLOWS
from scopemap.engine.geometry.align import AlignMode
from scopemap.input.opening import readers
from scopemap_bench.evaluation.depth import DepthScaling
from scopemap_bench.evaluation.protocols import PROTOCOLS
from scopemap_bench.phantom.spec import PhantomSpec, parse_events

_PLANS = "plans"
_METHOD_SETS = "method_sets"
_NESTING = 2  # folders around or within a sequence that the pattern does not name


class _PlanPart(BaseModel):
    """A part of the plan: frozen, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ProtocolPlan(_PlanPart):
    """How runs are scored.

    align : alignment of the trajectory, also applied to mesh and depth in mm.
    protocols : protocols of other papers, measured as well (`evaluation.protocols.PROTOCOLS`).
    surface, depth, consistency : whether these are measured, where there is a truth for them.
    contradiction : whether frames until the poses contradict the pictures are counted (`evaluation.failure`).
    icp : measure the mesh also after a refinement by ICP.
    flow : for consistency, the same for all methods, named as `networks.flow`.
    depth_scaling : scaling of predicted depth before it is compared with true depth.
    depth_range_mm : range of true depth that counts. clip_depth : whether predicted depth is clipped to it.
    """

    align: AlignMode = "sim3"
    protocols: tuple[str, ...] = ()
    surface: bool = True
    icp: bool = False
    depth: bool = True
    consistency: bool = False
    contradiction: bool = False
    flow: str = "dis"
    depth_scaling: DepthScaling = "median"
    depth_range_mm: tuple[float, float] = (1e-3, 1e4)
    clip_depth: bool = False

    @model_validator(mode="after")
    def _known_names(self) -> ProtocolPlan:
        unknown = [name for name in self.protocols if name not in PROTOCOLS]
        if unknown:
            raise ValueError(f"unknown protocol '{unknown[0]}': choose from {', '.join(PROTOCOLS)}")
        if self.flow not in FLOWS:
            raise ValueError(f"unknown flow '{self.flow}': choose from {', '.join(FLOWS)}")
        return self


class FigurePlan(_PlanPart):
    """What the figures of a sequence show; it changes no row.

    frame : number of the second of the two consecutive frames, by default in the middle.
    zoom : middle and side of the enlarged square of the mesh's picture, from left and top, over the picture's side.
    """

    frame: int | None = None
    zoom: tuple[float, float, Annotated[float, Field(gt=0, le=1)]] = (0.5, 0.5, 0.25)


class SequencePlan(_PlanPart):
    """One sequence, or all that a pattern finds.

    name : for tables; before the path of each sequence that a pattern finds.
    path : below the data folder. A pattern finds folders and videos, with `dataset` only those of its reader, in any
    spelling of SCARED's folders and within folders of the same name.
    phantom : settings of a `PhantomSpec` instead of a path; its `path_file` is below the data folder, its `seed` is
    added.
    dataset, camera, size, frames : as `open_sequence` takes them; frames as [first, end] or [first, end, step].
    depth : "": from the settings; "true": the data set's files; "files:FOLDER" below the data folder; or a
    `depth.backend`.
    near_far_mm : metric anchor of the first frame. align : replaces the protocol's. settings : dotted names to values.
    figure : what its figures show.
    """

    name: str = ""
    path: str = ""
    phantom: dict[str, Any] | None = None
    dataset: str | None = None
    camera: str | None = None
    size: tuple[int, int] | None = None
    frames: tuple[int, int] | tuple[int, int, int] | None = None
    depth: str = ""
    near_far_mm: tuple[float, float] | None = None
    align: AlignMode | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    figure: FigurePlan = FigurePlan()

    @model_validator(mode="after")
    def _one_source(self) -> SequencePlan:
        if bool(self.path) == (self.phantom is not None):
            raise ValueError(f"sequence '{self.name}' needs either a path or a phantom")
        if self.dataset is not None and self.dataset not in readers():
            raise ValueError(f"unknown data set '{self.dataset}': choose from {', '.join(readers())}")
        if self.phantom is not None:
            if not self.name:
                raise ValueError("a phantom needs a name")
            spec_of(self.phantom, 0)
        return self


class MethodPlan(_PlanPart):
    """One method.

    name : for tables and folders. use : "scopemap", "import", "colmap", or a baseline (`methods.method.BASELINES`).
    preset, settings : what it changes; a preset comes before the plan's and the sequence's settings, these after them.
    files : of `use = "import"`: trajectory below the data folder; may hold {sequence} and {seed}.
    unit, kind : of these files; without a unit that of their format.
    """

    name: str
    use: str = "scopemap"
    preset: Preset | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    files: str = ""
    unit: Literal["mm", "m"] | None = None
    kind: str = "auto"

    @model_validator(mode="after")
    def _usable(self) -> MethodPlan:
        if (self.use == "import") != bool(self.files):
            raise ValueError(f"method '{self.name}': `files` and use = \"import\" belong together")
        Config.load(self.preset, settings=self.settings)
        apart = [name for name in self.settings if name.startswith("input.") and name != "input.focal"]
        if apart:
            raise ValueError(f"method '{self.name}': all methods see the same frames; give {apart[0]} to the sequence")
        return self


class Plan(_PlanPart):
    """A whole benchmark."""

    title: str
    description: str = ""
    seeds: tuple[int, ...] = Field((0,), min_length=1)
    protocol: ProtocolPlan = ProtocolPlan()
    settings: dict[str, Any] = Field(default_factory=dict)
    sequence: tuple[SequencePlan, ...] = Field(min_length=1)
    method: tuple[MethodPlan, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> Plan:
        names = Counter(folder_name(method.name) for method in self.method)
        twice = [name for name, count in names.items() if count > 1]
        if twice:
            raise ValueError(f"two methods have the name '{twice[0]}' (letters and digits count)")
        Config.load(settings=self.settings)
        return self


def read_plan(plan: Path | str) -> Plan:
    """Return a plan from a TOML file, or one that comes with scopemap by its name; raises `SettingsError`."""
    text = _text_of(plan)
    try:
        return Plan.model_validate(_with_sets(tomllib.loads(text)))
    except ValidationError as error:
        raise SettingsError(f"the plan {plan}: " + "; ".join(explain(item) for item in error.errors())) from None
    except (RecursionError, ValueError) as error:
        raise SettingsError(f"cannot read the plan {plan}: {error}") from None
    except ScopemapError as error:
        raise SettingsError(f"the plan {plan}: {error}") from None


def shipped_plans() -> list[str]:
    """Return the names of the plans that come with scopemap."""
    return _names(_PLANS)


def found_sequences(plan: Plan, data: Path | None) -> tuple[list[SequencePlan], list[str]]:
    """Return the plan's sequences, patterns replaced, and a note for each missing one; `InputError` without any."""
    found: list[SequencePlan] = []
    missing: list[str] = []
    for sequence in plan.sequence:
        if sequence.phantom is not None:
            found.append(sequence)
        elif data is None:
            missing.append(f"{sequence.path}: needs --data, the folder that holds it")
        else:
            matches = _matches(sequence, data)
            found += [_at(sequence, name, path, data) for name, path in sorted(matches.items())]
            missing += [] if matches else [f"{sequence.path}: nothing like that in {data}"]
    if not found:
        raise InputError(f"no sequence of the plan '{plan.title}' is there: {missing[0]}")
    return found, missing


def _at(sequence: SequencePlan, name: str, path: Path, data: Path) -> SequencePlan:
    below = path.relative_to(data).as_posix() if path.is_relative_to(data) else str(path)
    full = sequence.name if sequence.name and name == sequence.path else " ".join(filter(None, (sequence.name, name)))
    return sequence.model_copy(update={"path": below, "name": full})


def _matches(sequence: SequencePlan, data: Path) -> dict[str, Path]:
    """Return the path itself if it exists, else the folders and videos that it finds as a pattern, by their names."""
    if (data / sequence.path).exists() or Path(sequence.path).is_absolute():
        return {sequence.path: data / sequence.path} if (data / sequence.path).exists() else {}
    named = {path.relative_to(data).as_posix(): path for path in sorted(data.glob(sequence.path))}
    if sequence.dataset is None:
        return {name: path for name, path in named.items() if path.is_dir() or _is_video(path)}
    recognises, wanted = readers()[sequence.dataset].recognises, _usual_spelling(sequence.path)
    found = {_usual_spelling(name): path for name, path in named.items() if recognises(path)}
    levels = len(PurePosixPath(wanted).parts)
    for path in _recognised(data, recognises, levels + _NESTING):
        parts = PurePosixPath(_usual_spelling(path.relative_to(data).as_posix())).parts
        # The frames may be in a folder within the one that the pattern names.
        names = ("/".join(parts[-levels:]), "/".join(parts[-levels - 1 : -1]))
        name = next((name for name in names if PurePosixPath(name).match(wanted)), None)
        if name is not None and path not in found.values():
            found.setdefault(name, path)
    return found


def _usual_spelling(path: str) -> str:
    """Return a path or pattern in SCARED's own spelling, without folders within their namesakes.

    dataset1/keyframe1, dataset_1/dataset_1/keyframe_1 and dataset_1_keyframe_1 are dataset_1/keyframe_1.
    """
    spelled = re.sub(r"(?:test_)?(dataset|keyframe)_?(?=[\d\[])", r"\1_", path).replace("_keyframe_", "/keyframe_")
    return "/".join(part for part, _ in groupby(spelled.split("/")))


def _recognised(folder: Path, recognises: Callable[[Path], bool], depth: int) -> Iterator[Path]:
    """Yield the folders of a data set's sequences, at most `depth` levels below a folder."""
    if not (folder.is_dir() and os.access(folder, os.R_OK | os.X_OK)):
        return
    for inner in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        if recognises(inner):
            yield inner
        elif depth > 1:
            yield from _recognised(inner, recognises, depth - 1)


def _is_video(path: Path) -> bool:
    return str(mimetypes.guess_type(path)[0]).startswith("video/")


def spec_of(phantom: dict[str, Any], seed: int, data: Path | None = None) -> PhantomSpec:
    """Return the phantom of a plan, `seed` added to its own; raises `SettingsError`."""
    settings = dict(phantom)
    events = parse_events(str(settings.pop("events", "")))
    if "path_file" in settings and data is not None:
        settings["path_file"] = data / settings["path_file"]
    spec = PhantomSpec().with_settings(settings)
    return replace(spec, seed=spec.seed + seed, events=events)


def folder_name(name: str) -> str:
    """Return a name that is safe for a folder."""
    return "".join(letter if letter.isalnum() or letter in "._+" else "-" for letter in name).strip("-.") or "unnamed"


def _with_sets(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a plan with the methods of its sets before its own."""
    methods: list[Any] = []
    for name in tree.pop("method_sets", []):
        file = resources.files("scopemap_bench") / _METHOD_SETS / f"{name}.toml"
        if not file.is_file():
            raise SettingsError(f"unknown set of methods '{name}': choose from {', '.join(_names(_METHOD_SETS))}")
        methods += tomllib.loads(file.read_text(encoding="utf-8"))["method"]
    return tree | {"method": methods + tree.get("method", [])}


def _names(folder: str) -> list[str]:
    files = (resources.files("scopemap_bench") / folder).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def _text_of(plan: Path | str) -> str:
    shipped = resources.files("scopemap_bench") / _PLANS / f"{plan}.toml"
    try:
        return shipped.read_text(encoding="utf-8") if shipped.is_file() else Path(plan).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        known = f"Name a TOML file, or one of those that come with scopemap: {', '.join(shipped_plans())}"
        raise SettingsError(f"cannot read the plan {plan}: {error}. {known}") from None
