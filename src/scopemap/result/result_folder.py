"""The folder of a result: filled out of sight, and put in place when the result is whole."""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed
    fcntl = None  # type: ignore[assignment]

from scopemap.engine.errors import InputError
from scopemap.result.checkpoint import CHECKPOINT, CHECKPOINT_NEW, discard_checkpoint, has_checkpoint

UNFINISHED = ".unfinished"
"""Folder within a result's folder, in which a run writes until it is finished."""

LOCK = "process"
"""File there by which the folder is locked; it is not of the result."""

STORED = "stored_frames"
"""Folder there with the frames that are fused after the last one; it is not of the result."""

VIEW = "view"
"""Folder there with what can be seen of the run while it goes on; it is not of the result."""

NOT_OF_THE_RESULT = (LOCK, STORED, CHECKPOINT, CHECKPOINT_NEW, VIEW)
"""Files and folders there that a run needs to go on, and that go with the folder."""

SUMMARY_PICTURE = "summary.png"
"""File of a result with a report: the verdict, some frames and the surface in one picture."""

_REPLACED = "replaced"
_MOVING = "moving"
_OWN_FILES = (
    "trajectory.tum", "mesh.ply", "mesh.glb", "camera.yaml", "source_camera.yaml", "frames.csv", "config.toml",
    "provenance.json", "report.html", SUMMARY_PICTURE, "SHA256SUMS", "measurements.json", "mesh_over_time.glb",
)  # fmt: skip
_OWN_FOLDERS = ("depth", "depth_sigma", "depth_preview", "frames", "pictures", "maps", "against_video", "surfaces")
# Files by which a run's folder is recognised.
_MARKS = ("provenance.json", "depth/depth.json")


@contextmanager
def result_folder(
    out: Path | str | None, *, overwrite: bool, can_resume: Callable[[Path], bool] = lambda unfinished: False
) -> Iterator[Path | None]:
    """Yield a folder to write a run's result to; its content is in `out` afterwards. None for None.

    can_resume : whether the run resumes from what a killed one has left in that folder; else it is emptied.

    Where the work in between raises, `out` is as it was before; what was written is removed, but for a checkpoint and
    what belongs to it. An earlier run in `out` is removed with `overwrite`, in the end; other files stay.
    Raises `InputError` where `out` is not empty and may not be overwritten, is no run's folder, or cannot be written.
    """
    if out is None:
        yield None
        return
    folder = Path(out)
    check_result_folder(folder, overwrite=overwrite)
    is_new, unfinished = not folder.exists(), folder / UNFINISHED
    with _locked(folder, can_resume):
        try:
            yield unfinished
            _put_in_place(unfinished, folder)
        except BaseException as error:
            if has_checkpoint(unfinished):
                error.add_note(
                    f"a checkpoint is kept in {folder}: the same command resumes from there, --no-resume starts again"
                )
            else:
                shutil.rmtree(unfinished, ignore_errors=True)
                if is_new:
                    with suppress(OSError):
                        folder.rmdir()
            raise


@contextmanager
def _locked(folder: Path, can_resume: Callable[[Path], bool]) -> Iterator[None]:
    """Keep the folder of the unfinished run from other runs until this one or its process ends."""
    unfinished = folder / UNFINISHED
    try:
        lock = _lock(folder)
        _undo_moves(unfinished, folder)
        if not can_resume(unfinished):
            for left in unfinished.iterdir():
                if left.name != LOCK:
                    shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
    except OSError as error:
        raise InputError(f"cannot write a run to {folder}: {error.strerror or error}") from None
    if fcntl is None:
        lock.close()
        yield
    else:
        with lock:
            yield


def _lock(folder: Path) -> IO[bytes]:
    """Return the file by which a folder is locked, open; it is unlocked where that is closed or the process ends."""
    while True:
        (folder / UNFINISHED).mkdir(parents=True, exist_ok=True)
        lock = (folder / UNFINISHED / LOCK).open("ab+", buffering=0)
        if not _is_taken(lock):
            # Another run may have ended, and removed the file, since it was opened.
            if os.fstat(lock.fileno()).st_nlink or os.name != "posix":
                with suppress(OSError):  # a full disk: what is written next tells
                    lock.truncate(0)
                    lock.write(f"{os.getpid()} on {platform.node()}".encode())
                return lock
            lock.close()
            continue
        lock.close()
        _refuse_locked(folder)


def _is_taken(lock: IO[str] | IO[bytes]) -> bool:
    """Lock an open file, and return whether another process or thread has done so; False where files have no locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system of a network that knows none
        pass
    return False


def _refuse_locked(folder: Path) -> None:
    """Raise `InputError` where another run is writing to a folder."""
    with suppress(FileNotFoundError), (folder / UNFINISHED / LOCK).open(encoding="utf-8") as lock:
        writer = lock.read(200)
        if _is_taken(lock):
            raise InputError(
                f"cannot write a run to {folder}: process {writer} is writing one there; name another folder"
            )


def check_result_folder(folder: Path, *, overwrite: bool) -> None:
    """Raise `InputError` where no run can be written to a folder, as `result_folder` does."""
    try:
        _refuse(folder, overwrite)
    except OSError as error:
        raise InputError(f"cannot write a run to {folder}: {error.strerror or error}") from None


def _refuse(folder: Path, overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write a run to {folder}: a file has that name")
    if not folder.exists():
        parent = next(path for path in folder.parents if path.exists())
        if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
            raise InputError(f"cannot write a run to {folder}: nothing can be written to {parent}; name another folder")
        return
    # A run that was killed while it was put in place is taken back before the folder is used.
    is_empty = all(path.name == UNFINISHED for path in folder.iterdir())
    if not is_empty and not (folder / UNFINISHED / _MOVING).is_file():
        if not overwrite:
            raise InputError(
                f"cannot write a run to {folder}: it is not empty; name another folder, or replace the earlier run "
                "there by --overwrite"
            )
        if not any((folder / mark).is_file() for mark in _MARKS):
            raise InputError(f"will not overwrite {folder}: it holds no run; name another folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"cannot write a run to {folder}: the folder is read-only; name another one")
    _refuse_locked(folder)


def _put_in_place(unfinished: Path, folder: Path) -> None:
    """Exchange an earlier run for the new one by renaming alone, and back where that fails or is ended."""
    replaced, moving = unfinished / _REPLACED, unfinished / _MOVING
    try:
        new = sorted(path.name for path in unfinished.iterdir() if path.name not in NOT_OF_THE_RESULT)
        # What marks a run goes first and comes last.
        new.sort(key=lambda name: name in _MARKS)
        old = sorted({*_OWN_FILES, *_OWN_FOLDERS, *new}, key=lambda name: name not in _MARKS)
        replaced.mkdir()
        moving.write_text(json.dumps({"new": new, "old": old}), encoding="utf-8")
        try:
            _move(old, folder, replaced)
            _move(new, unfinished, folder)
        except BaseException:
            _undo_moves(unfinished, folder)
            raise
        moving.unlink()
        with suppress(OSError):
            # First: a run that resumed from it would miss the files that were moved.
            discard_checkpoint(unfinished)
    except OSError as error:
        raise InputError(f"cannot write the result to {folder}: {error.strerror or error}") from None
    shutil.rmtree(unfinished, ignore_errors=True)


def _undo_moves(unfinished: Path, folder: Path) -> None:
    """Take a run back that was being put in place, and put the earlier one back."""
    moving, replaced = unfinished / _MOVING, unfinished / _REPLACED
    try:
        names = json.loads(moving.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):  # nothing was moved
        names = {"new": [], "old": []}
    else:
        _move(names["new"], folder, unfinished)
        _move(names["old"], replaced, folder)
        moving.unlink()
    shutil.rmtree(replaced, ignore_errors=True)


def _move(names: list[str], source: Path, target: Path) -> None:
    """Move what there is of some files and folders, and links to such, from one folder to another that has none."""
    for name in names:
        if os.path.lexists(source / name) and not os.path.lexists(target / name):
            (source / name).replace(target / name)
