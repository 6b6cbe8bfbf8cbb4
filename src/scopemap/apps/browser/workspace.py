"""What the window works on: a folder of videos, the results beside them, videos that were sent, and runs."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from scopemap.apps.browser.runs import BrowserRun, RunQueue
from scopemap.engine.errors import InputError
from scopemap.result.result import Result

_RESULTS = "scopemap"
_UPLOADS = "uploads"
_VIDEOS = {
    ".mp4",
    ".mkv",
    ".avi",
    ".mov",
    ".mpg",
    ".mpeg",
    ".m4v",
    ".webm",
    ".wmv",
    ".ts",
    ".mts",
    ".m2ts",
    ".dcm",
    ".bag",
}
_MOST_LISTED = 200


class Workspace:
    """A folder of videos, FOLDER/scopemap with their results, and the runs that were asked for.

    keep_uploads : whether videos that are sent stay, in FOLDER/scopemap/uploads; else they go with the session.
    most_bytes : of one video that is sent.
    """

    def __init__(self, folder: Path, *, keep_uploads: bool = False, most_bytes: int = 4_000_000_000) -> None:
        self.folder, self.results, self.most_bytes = folder, folder / _RESULTS, most_bytes
        self._session = Path(tempfile.mkdtemp(prefix="scopemap-app-"))
        self.uploads = self.results / _UPLOADS if keep_uploads else self._session / _UPLOADS
        self.keeps_uploads = keep_uploads
        self.runs = RunQueue(self.logs)

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.runs.close()
        shutil.rmtree(self._session, ignore_errors=True)

    @property
    def videos(self) -> list[Path]:
        """Videos of the folder, and folders of it that hold images, by name; the first 200."""
        found = [path for path in sorted(self.folder.iterdir()) if path.name != _RESULTS and not path.is_symlink()]
        return [path for path in found if _may_be_input(path)][:_MOST_LISTED]

    @property
    def finished(self) -> list[Path]:
        """Folders of finished results, those beside the videos and those in FOLDER/scopemap, the latest first."""
        inside = [self.folder, self.results] if self.results.is_dir() else [self.folder]
        folders = [path for place in inside for path in place.iterdir() if path.is_dir() and not path.is_symlink()]
        done = [path for path in folders if (path / "provenance.json").is_file() and Result(path).is_finished]
        return sorted(done, key=lambda path: -(path / "provenance.json").stat().st_mtime)[:_MOST_LISTED]

    @property
    def logs(self) -> Path:
        """Folder for what processes print; it goes with the session."""
        return self._session / "logs"

    def inside(self, name: str) -> Path:
        """Return the path of a name in the folder; raises `InputError` where it leads out of it."""
        path = (self.folder / name).resolve()
        if not path.is_relative_to(self.folder.resolve()):
            raise InputError(f"{name} is not in {self.folder}")
        return self.folder / name

    def new_upload(self, name: str) -> Path:
        """Return a file for a video that is sent, named by us; its folder is made."""
        self.uploads.mkdir(parents=True, exist_ok=True)
        ending = Path(name).suffix.lower()
        ending = ending if ending in _VIDEOS else ".video"
        number = 1 + max(
            [int(found[1]) for file in self.uploads.iterdir() if (found := re.match(r"video_(\d+)", file.name))],
            default=0,
        )
        return self.uploads / f"video_{number:03d}{ending}"

    def new_result(self, source: Path) -> Path:
        """Return a folder for a result of an input: FOLDER/scopemap/NAME, numbered where that is taken.

        A folder that holds only what a killed run left is taken again: the same run goes on there.
        """
        stem = re.sub(r"[^\w.-]+", "_", source.stem if source.is_file() else source.name) or "video"
        number = 1
        while True:
            out = self.results / (stem if number == 1 else f"{stem}_{number}")
            if not out.exists() or {path.name for path in out.iterdir()} <= {".unfinished"}:
                if all(run.out != out or run.status in ("failed", "stopped") for run in self.runs.runs):
                    return out
            number += 1

    def reconstruct(self, source: Path, arguments: Sequence[str], out: Path | None = None) -> BrowserRun:
        """Put a run of an input at the end of the queue, and return it."""
        self.results.mkdir(parents=True, exist_ok=True)
        return self.runs.ask(source, self.new_result(source) if out is None else out, arguments)


def _may_be_input(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in _VIDEOS
    if (path / "provenance.json").is_file():
        return False
    return path.is_dir() and any(
        file.suffix.lower() in {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"} for file in path.iterdir()
    )
