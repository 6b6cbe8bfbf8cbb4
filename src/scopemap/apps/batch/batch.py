"""Many videos: each in a folder of its own, with a record of what became of it.

OUT/NAME/ (the result)    OUT/records/NAME.json    OUT/logs/NAME.txt (what its process printed)    OUT/batch.csv
OUT/.fetched/NAME/ (a video that came from an address, while it is run)
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scopemap.apps.batch.engines import Engine
from scopemap.engine.config import Config
from scopemap.engine.errors import reporting
from scopemap.input.inputs import NamedInput, RemoteFile
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence as Frames
from scopemap.report.batch_page import BatchRow, write_at_once, write_batch_page, write_batch_table
from scopemap.report.page import write_report
from scopemap.result.evidence import frames_in_result
from scopemap.result.result import Result
from scopemap.result.verdict import verdict
from scopemap.runner.processes import Outcome, ProcessLimits, run_in_processes
from scopemap.runner.with_report import reconstruct_with_report

INDEX = "index.html"
TABLE = "batch.csv"
RECORDS = "records"
LOGS = "logs"
_FETCHED = ".fetched"
_LONGEST_NAME = 80
_SECONDS_BETWEEN_TABLES = 10.0
_OTHER = "its folder holds a result of another input or of other settings: name another --out, or give --overwrite"


@dataclass(frozen=True)
class Video:
    """One input of a batch: the name of its folder, and what `open_sequence` and `reconstruct` take."""

    path: Path | RemoteFile
    name: str
    config: Config
    dataset: str | None = None
    camera: str | None = None
    fov_deg: float | None = None
    size: tuple[int, int] | None = None
    frames: slice | None = None

    def fetched(self, out: Path) -> Video:
        """Return it as it can be opened: from an address, it is copied into the folder of the batch first.

        The place is the same each time, as a run is known by it that is resumed. Raises what `RemoteFile.fetch` does.
        """
        if isinstance(self.path, Path):
            return self
        return replace(self, path=self.path.fetch(out / _FETCHED / self.name))

    def forget_fetched(self, out: Path) -> None:
        """Remove what `fetched` has copied."""
        shutil.rmtree(out / _FETCHED / self.name, ignore_errors=True)
        with suppress(OSError):  # those of others are there
            (out / _FETCHED).rmdir()

    def open(self, frames: slice | None = None) -> Frames:
        """Return its frames, by default those that are chosen. Raises what `open_sequence` does."""
        assert isinstance(self.path, Path)
        return open_sequence(
            self.path,
            dataset=self.dataset,
            camera=self.camera,
            fov_deg=self.fov_deg,
            size=self.size,
            frames=frames or self.frames,
            settings=self.config.input,
        )

    def key(self) -> str:
        """Return what tells this input with these settings from others, 40 hexadecimal digits.

        An input is known by its path, size and time of change; a folder by those of what is in it; what is at an
        address by that, its size and its ETag or time of change.
        """
        choice = [self.dataset, self.camera, self.fov_deg, self.size, str(self.frames), self.config.toml()]
        return _digest([_place(self.path), _state(self.path), choice])[:40]


@dataclass(frozen=True)
class _RunTask:
    video: Video
    out: Path
    before: int | None


def folder_names(inputs: Sequence[NamedInput]) -> list[str]:
    """Return a name for the folder of each input, safe in any file system, and unique whatever the case of letters.

    It is the cell `name`, else the file's name without its ending, else, where several would share it, that with the
    name of the folder around it, else that with digits of a hash.
    """
    plain = [_safe(one.columns.get("name") or _stem(one.path)) for one in inputs]
    longer = [_safe(f"{Path(_place(one.path)).parent.name}_{_stem(one.path)}") for one in inputs]
    count = Counter(name.lower() for name in [*plain, INDEX, TABLE, RECORDS, LOGS])
    of_longer = Counter(name.lower() for name in longer) + count
    names = []
    for one, short, long in zip(inputs, plain, longer, strict=True):
        if count[short.lower()] == 1:
            names.append(short)
        elif of_longer[long.lower()] == 1:
            names.append(long)
        else:
            names.append(f"{long}-{_digest([_place(one.path), sorted(one.columns.items())])[:12]}")
    return names


def run_batch(
    videos: Sequence[Video],
    out: Path,
    limits: ProcessLimits,
    *,
    engine: Engine = run_in_processes,
    overwrite: bool = False,
    part: tuple[int, int] = (1, 1),
    on_change: Callable[[BatchRow, int], None] = lambda row, left: None,
) -> list[BatchRow]:
    """Run videos and return a row for each; one whose folder holds its result already is not run again.

    engine : what runs them. part : (k, n): of n parts only the k-th. on_change : called with the row of a video that
    begins or ends, and how many are left. Writes batch.csv and index.html of all videos, and with a part a table of its
    own, too. Raises `InputError` where `out` cannot be written, and what the engine does.
    """
    with reporting(f"cannot write a batch to {out}"):
        for folder in (RECORDS, LOGS):
            (out / folder).mkdir(parents=True, exist_ok=True)
    mine = videos[part[0] - 1 :: part[1]]
    rows = {video.name: _row_before(video, out, overwrite=overwrite) for video in mine}
    due = [video for video in mine if rows[video.name].status in ("waiting", "started")]
    left, written_s = len(due), time.monotonic()
    for row in rows.values():
        if row.status == "failed":
            on_change(row, left)

    def put(row: BatchRow) -> None:
        rows[row.folder] = row
        write_at_once(out / RECORDS / f"{row.folder}.json", json.dumps(asdict(row), indent=1))
        on_change(row, left)

    def begin(number: int) -> None:
        put(replace(rows[due[number].name], status="started"))

    tasks = [_RunTask(video, out.absolute(), rows[video.name].before) for video in due]
    try:
        with closing(engine(_run, tasks, limits, begin)) as ended:
            for number, outcome in ended:
                left -= 1
                due[number].forget_fetched(out)
                put(_row_after(rows[due[number].name], outcome, out))
                if time.monotonic() - written_s > _SECONDS_BETWEEN_TABLES:
                    _write_part(list(rows.values()), out, part)
                    written_s = time.monotonic()
    finally:
        for video in due:
            video.forget_fetched(out)
        _write_part(list(rows.values()), out, part)
        _write_overview(videos, rows, out)
    return list(rows.values())


def _run(task: _RunTask) -> dict[str, Any]:
    """Run a video in this process, and return what its row says of the result."""
    video, folder = task.video, task.out / task.video.name
    log_to(task.out / LOGS / f"{video.name}.txt")
    if _written(folder) in (None, task.before):
        frames = video.fetched(task.out).open()
        reconstruct_with_report(frames, video.config, folder, overwrite=task.before is not None)
    else:  # the process ended while it wrote the report
        write_report(folder)
    run = Result(folder).checked()
    found, (tracked, of) = verdict(run), frames_in_result(run.frames)
    return {"verdict": found.word, "sentence": found.sentence, "tracked": tracked, "frames": of}


def log_to(file: Path) -> None:
    """Let what this process prints go to a file from now on, what crashing libraries print, too."""
    sys.stdout.flush()
    sys.stderr.flush()
    with file.open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)


def _row_before(video: Video, out: Path, *, overwrite: bool) -> BatchRow:
    """Return the row of a video before it is run: done, failed where it may not be run, waiting, or started."""
    key, written, record = video.key(), _written(out / video.name), read_record(out, video.name)
    new = BatchRow(str(video.path), video.name, key=key, before=written)
    if record is None or record.key != key:
        is_refused = written is not None and not overwrite
        return replace(new, status="failed", reason=_OTHER) if is_refused else new
    if written not in (None, record.before):
        return record if record.status == "done" else replace(record, status="started", reason="")
    return replace(new, seconds=record.seconds)


def _row_after(row: BatchRow, outcome: Outcome, out: Path) -> BatchRow:
    """Return the row of a video whose process has ended it."""
    log = out / LOGS / f"{row.folder}.txt"
    has_log = log.is_file() and log.stat().st_size > 0
    if not has_log:
        log.unlink(missing_ok=True)
    row = replace(row, seconds=round(row.seconds + outcome.seconds, 3))
    if not outcome.fault:
        return replace(row, status="done", reason="", **outcome.value)
    tries = f" ({outcome.attempts} attempts)" if outcome.attempts > 1 else ""
    where = f"; see {LOGS}/{log.name}" if has_log else ""
    return replace(row, status="failed", reason=outcome.fault + tries + where)


def read_record(out: Path, name: str) -> BatchRow | None:
    """Return the row that an earlier call has left of a video; None where there is none, or a damaged one."""
    try:
        return BatchRow(**json.loads((out / RECORDS / f"{name}.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _write_part(rows: list[BatchRow], out: Path, part: tuple[int, int]) -> None:
    write_batch_table(rows, out / (TABLE if part[1] == 1 else f"batch-{part[0]}-of-{part[1]}.csv"))


def _write_overview(videos: Sequence[Video], rows: dict[str, BatchRow], out: Path) -> None:
    """Write table and page of all videos, and of those of earlier calls."""
    earlier = [file.stem for file in sorted((out / RECORDS).glob("*.json"))]
    found = {name: rows.get(name) or read_record(out, name) for name in [*(v.name for v in videos), *earlier]}
    waiting = {video.name: BatchRow(str(video.path), video.name) for video in videos}
    shown = [row or waiting[name] for name, row in found.items() if row or name in waiting]
    write_batch_table(shown, out / TABLE)
    write_batch_page(shown, out / INDEX)


def _written(folder: Path) -> int | None:
    """Return when the result in a folder was written, ns since 1970; None where there is none."""
    try:
        return (folder / "provenance.json").stat().st_mtime_ns
    except OSError:
        return None


def _place(path: Path | RemoteFile) -> str:
    return path.address if isinstance(path, RemoteFile) else str(path.absolute())


def _state(path: Path | RemoteFile) -> list[Any]:
    """Return what changes with an input, of a file or of what is in a folder; [] for what is not there."""
    if isinstance(path, RemoteFile):
        return [path.size, path.version]
    try:
        if not path.is_dir():
            return [path.stat().st_size, int(path.stat().st_mtime)]
        with os.scandir(path) as entries:
            facts = [(entry.name, entry.stat().st_size, int(entry.stat().st_mtime)) for entry in entries]
        return [_digest(sorted(facts))]
    except OSError:
        return []


def _digest(facts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _stem(path: Path | RemoteFile) -> str:
    if isinstance(path, RemoteFile):
        return Path(path.name).stem
    return path.absolute().name if path.is_dir() else path.stem


def _safe(name: str) -> str:
    """Return a name without what some file system or shell does not take, at most 80 letters."""
    return re.sub(r"[^\w.-]+", "_", name)[:_LONGEST_NAME].strip("._-") or "video"
