"""What the window works on: a folder of videos, the results beside them, videos that were sent, and runs."""

from __future__ import annotations

import re
import shutil
import tempfile
import unicodedata
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import cv2
import numpy as np

from scopemap.apps.browser.runs import BrowserRun, RunQueue
from scopemap.apps.browser.uploads import PART, UNKNOWN_KIND, Receiver
from scopemap.engine.errors import InputError, ScopemapError
from scopemap.input.decoding import read_decoded
from scopemap.input.opening import VIDEO_ENDINGS
from scopemap.result.result import Result
from scopemap.result.result_folder import UNFINISHED
from scopemap.result.verdict import level_of_submap
from scopemap.result.wording import LEVEL_WORDS

_RESULTS = "scopemap"
_UPLOADS = "uploads"
_MASKS = "masks"
_CALIBRATIONS = "calibrations"
_MOST_CALIBRATION_BYTES = 1_000_000
_LARGER = ": put it into the folder of scopemap app, or start that with --upload-limit GB"
DEMONSTRATION = "demonstration"
"""Folder in FOLDER/scopemap that holds the clip of the demonstration."""

_OURS = (_UPLOADS, _MASKS, DEMONSTRATION)
"""Folders in FOLDER/scopemap that are no results."""
_MARK = "provenance.json"
_MOST_NAMED = 80
_MOST_KEPT = 60
"""Letters that are kept of a sent file's name: with what is added to them the file's system takes them."""
_VIDEOS = {*VIDEO_ENDINGS, ".dcm", ".bag"}
_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}
_MOST_LISTED = 200
_NO_PICTURE = 200
VIDEO_KINDS = ",".join(("video/*", *sorted(_VIDEOS)))
"""Kinds of files that are taken for videos, as browsers have them."""


class Workspace:
    """A folder of videos, FOLDER/scopemap with their results, and the runs that were asked for.

    keep_uploads : whether videos that are sent stay, in FOLDER/scopemap/uploads; else they go with the session.
    most_bytes : of one video that is sent.
    """

    def __init__(self, folder: Path, *, keep_uploads: bool = False, most_bytes: int = 4_000_000_000) -> None:
        self._receivers: dict[str, Receiver] = {}
        # Absolute: a name that begins with "-" would be an option of the run's command.
        self.folder, self.most_bytes = folder.absolute(), most_bytes
        self.results = self.folder / _RESULTS
        self._session = Path(tempfile.mkdtemp(prefix="scopemap-app-"))
        self.uploads = self.results / _UPLOADS if keep_uploads else self._session / _UPLOADS
        self.keeps_uploads = keep_uploads
        self.runs = RunQueue(self.logs, self.new_result)

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.runs.close()
        for receiver in self._receivers.values():
            receiver.close()
        shutil.rmtree(self._session, ignore_errors=True)

    @property
    def videos(self) -> list[Path]:
        """Videos of the folder, and folders of it that hold images, by name; the first 200."""
        found = [path for path in _inside(self.folder) if path.name != _RESULTS]
        return [path for path in found if _may_be_input(path)][:_MOST_LISTED]

    @property
    def sent(self) -> list[Path]:
        """Videos that were sent to the page, the latest first."""
        found = [path for path in _inside(self.uploads) if path.suffix in {*_VIDEOS, UNKNOWN_KIND}]
        return sorted(found, key=lambda path: -path.stat().st_mtime)[:_MOST_LISTED]

    @property
    def finished(self) -> list[Path]:
        """Folders of finished results, those beside the videos and those in FOLDER/scopemap, the latest first."""
        done = [path for path in (*_inside(self.folder), *_inside(self.results)) if _is_result(path)]
        return sorted(done, key=lambda path: -(path / _MARK).stat().st_mtime)[:_MOST_LISTED]

    @property
    def interrupted(self) -> list[Path]:
        """Folders in FOLDER/scopemap of killed runs, which no run of this session writes to or has kept."""
        writing = {run.out for run in self.runs.runs if run.status in ("waiting", "running", "stopped")}
        found = [path for path in _inside(self.results) if path not in writing and path.name not in _OURS]
        return [path for path in found if _is_left(path)][:_MOST_LISTED]

    @property
    def logs(self) -> Path:
        """Folder for what processes print; it goes with the session."""
        return self._session / "logs"

    def receiver(self, server: Any, kind: Literal["video", "calibration"]) -> Receiver:
        """Return what takes files of a kind that are sent to the page of viser's server."""
        if kind not in self._receivers:
            self._receivers[kind] = (
                Receiver(server, kind, self.new_upload, self.most_bytes, _LARGER)
                if kind == "video"
                else Receiver(server, kind, self.new_calibration, _MOST_CALIBRATION_BYTES)
            )
        return self._receivers[kind]

    def inside(self, name: str) -> Path:
        """Return the path of a name in the folder; raises `InputError` where it leads out of it, or to nothing."""
        try:
            path = (self.folder / name).resolve()
            if not path.is_relative_to(self.folder.resolve()):
                raise InputError(f"{name} is not in {self.folder}: move it there, or start scopemap app in its folder")
            if not path.exists():
                raise InputError(f"there is no {name} in {self.folder}")
        except (OSError, ValueError) as error:  # names that are too long, or that hold a zero
            raise InputError(f"cannot look for {name[:_MOST_NAMED]!r} in {self.folder}: {error}") from None
        return self.folder / name

    def new_upload(self, name: str) -> Path:
        """Return a file for a video that is sent, with its own name made safe; its folder is made."""
        ending = Path(name).suffix.lower()
        if ending in _VIDEOS:
            return _free_place(self.uploads, Path(name).stem, ending)
        return _free_place(self.uploads, Path(name).name, UNKNOWN_KIND)

    @property
    def calibrations(self) -> Path:
        """Folder of calibrations that were sent; not that of the videos: what is beside one is taken unasked."""
        return self.uploads / _CALIBRATIONS

    @property
    def sent_calibrations(self) -> list[Path]:
        """Calibrations that were sent to the page, by name."""
        return [path for path in _inside(self.calibrations) if path.suffix != PART][:_MOST_LISTED]

    def new_calibration(self, name: str) -> Path:
        """Return a file for a calibration that is sent, with its own name made safe; its folder is made."""
        ending = Path(name).suffix.lower()
        is_plain = re.fullmatch(r"\.[a-z0-9]+", ending) and ending != PART
        return _free_place(self.calibrations, Path(name).stem, ending if is_plain else ".txt")

    def masks_of(self, source: Path) -> Path:
        """Return the folder for masks of an input's inset pictures; the same each time, so that a run resumes."""
        return self.results / _MASKS / self._stem(source)

    def new_result(self, source: Path) -> Path:
        """Return a folder for a result of an input: FOLDER/scopemap/NAME, numbered where that is taken.

        A folder that holds only what a killed run left is taken again: the same run goes on there.
        """
        stem, number = self._stem(source), 1
        while True:
            out = self.results / (stem if number == 1 else f"{stem}_{number}")
            is_taken = any(run.out == out and run.holds_its_folder for run in self.runs.runs)
            if not is_taken and (not out.exists() or _is_left(out)):
                return out
            number += 1

    @staticmethod
    def _stem(source: Path) -> str:
        stem = re.sub(r"[^\w.-]+", "_", source.name if source.is_dir() else source.stem).strip(".") or "video"
        return f"{stem}_" if stem in _OURS else stem

    def reconstruct(self, source: Path, arguments: Sequence[str]) -> BrowserRun:
        """Put a run of an input at the end of the queue, and return it; the same one that was stopped goes on."""
        for run in self.runs.runs:
            if (run.status, run.source, run.arguments) == ("stopped", source, tuple(arguments)):
                run.go_on()
                return run
        self.results.mkdir(parents=True, exist_ok=True)
        return self.runs.ask(source, self.new_result(source), arguments)


def _inside(folder: Path) -> list[Path]:
    """Return what is in a folder, by name, but for links: they may lead out of it; [] where it cannot be read."""
    try:
        return [path for path in sorted(folder.iterdir()) if not path.is_symlink()]
    except OSError:
        return []


def _free_place(folder: Path, stem: str, ending: str) -> Path:
    """Return a file in a folder, which is made: with the name that a person gave it, numbered where that is taken.

    Of the name are kept: letters, digits, "_", "." and "-". With "." or "-" first it would be hidden, or an option.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", stem)).lstrip(".-")[:_MOST_KEPT] or "file"
    number, path = 1, folder / f"{kept}{ending}"
    while path.exists() or path.with_name(path.name + PART).exists():
        number += 1
        path = folder / f"{kept}_{number}{ending}"
    return path


def made_and_word(folder: Path) -> str:
    """Return when a finished result was made, and its verdict: "2026-11-28 08:15, good"."""
    # In the person's own time.
    made = datetime.fromtimestamp((folder / _MARK).stat().st_mtime)
    run = Result(folder)
    return f"{made:%Y-%m-%d %H:%M}, {LEVEL_WORDS[level_of_submap(run)]}"


def in_time(one: Path, other: Path) -> tuple[Path, Path]:
    """Return two finished results, the one that was made earlier first."""
    made = [(folder / _MARK).stat().st_mtime for folder in (one, other)]
    return (one, other) if made[0] <= made[1] else (other, one)


def thumbnail(folder: Path) -> np.ndarray:
    """Return the picture of a frame in the middle of a finished result, (h, w, 3) uint8; a grey pixel: it has none."""
    run = Result(folder)
    inside = set(run.tracked["index"].tolist())
    seen = [index for index in run.pictured if index in inside]
    found = read_decoded(run.picture_file(seen[len(seen) // 2]), cv2.IMREAD_COLOR) if seen else None
    return np.full((1, 1, 3), _NO_PICTURE, np.uint8) if found is None else np.ascontiguousarray(found[..., ::-1])


def _is_result(path: Path) -> bool:
    try:
        return (path / _MARK).is_file() and Result(path).is_finished
    except (OSError, ScopemapError):  # a damaged one
        return False


def _is_left(path: Path) -> bool:
    """Return whether a folder holds nothing, or what a killed run left."""
    return path.is_dir() and {file.name for file in path.iterdir()} <= {UNFINISHED}


def _may_be_input(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in _VIDEOS
    return not (path / _MARK).is_file() and any(file.suffix.lower() in _IMAGES for file in _inside(path))
