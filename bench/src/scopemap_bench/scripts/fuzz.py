"""Damaged inputs: does every reader end in success or in one clear sentence?

    python -m scopemap_bench.scripts.fuzz [--count 20000] [--seed 0] [--only NAME ...] [--again NUMBER]

Takes the made-up copies of all layouts of data sets, calibrations, trajectories, settings and results from the tests,
damages one to three of their files (every other time a file inside an archive, which is closed again), opens what is
left as a user would and reads all of it. Anything that is neither success nor a `ScopemapError`, takes over 10 s of the
processor or over 1 GB of memory is a finding, printed with the number that makes it again.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tarfile
import tempfile
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

from scopemap.actions.verifying import verify_result
from scopemap.cameras.formats.reading import read_calibration
from scopemap.config import Config, DepthSettings
from scopemap.depth.files import FilesDepth
from scopemap.errors import ScopemapError
from scopemap.io.checksums import write_checksums
from scopemap.io.depth_maps import DepthReader
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap.io.run_folder import RunFolder
from scopemap.masking.mask_files import MaskFiles
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.datasets.checking import check
from scopemap_bench.datasets.survey import survey
from scopemap_bench.plan import read_plan
from scopemap_bench.scripts.measuring import options_of, print_head, print_row

TESTS = Path(__file__).resolve().parents[4] / "tests"
SLOWEST_S = 10
MOST_MEMORY_KB = 1 << 20
_STRANGE = ("nan", "inf", "-inf", "-1", "0", "1e308", "1e-320", "9" * 20, "", "x", "1,5", "0x10", "\u0661")
_HOLLOW = (b"", b"\0" * 64, b"\n\n\n", b"%YAML:1.0\n---\n", b"<?xml version='1.0'?>", b"{}", b"[]")
_TARS, _ZIPS = (".gz", ".tgz", ".tar"), (".zip", ".xlsx")
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_READ, _REFUSED, _FINDING = "read", "refused with one sentence", "FINDINGS"


class TooSlowError(BaseException):
    """Time is up; no reader that catches what damaged bytes end in may take this for a damage."""


# ---- damages: of the bytes of a file, and of the file itself


def cut_off(chance: random.Random, content: bytes) -> bytes:
    """Keep the first part only."""
    return content[: chance.randrange(len(content) + 1)]


def change_bytes(chance: random.Random, content: bytes) -> bytes:
    """Put other bytes here and there, near the beginning more often than not."""
    changed = bytearray(content)
    end = min(len(changed), chance.choice((16, 64, 512, 1 << 30)))
    for _ in range(chance.randint(1, 8) if end else 0):
        changed[chance.randrange(end)] = chance.choice((0, 1, 127, 128, 255, chance.randrange(256)))
    return bytes(changed)


def replace_number(chance: random.Random, content: bytes) -> bytes:
    """Write something strange where a number stood."""
    places = list(_NUMBER.finditer(content[: 1 << 16]))
    if not places:
        return content
    place = chance.choice(places)
    return content[: place.start()] + chance.choice(_STRANGE).encode() + content[place.end() :]


def shuffle_lines(chance: random.Random, content: bytes) -> bytes:
    """Double, take away or swap lines."""
    lines = content.split(b"\n")
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(3):
        case 0:
            lines.insert(one, lines[other])
        case 1:
            del lines[one]
        case _:
            lines[one], lines[other] = lines[other], lines[one]
    return b"\n".join(lines)


def hollow(chance: random.Random, content: bytes) -> bytes:
    """Leave nothing, or nothing but zeros or blanks."""
    return chance.choice(_HOLLOW)


def exchange(chance: random.Random, file: Path) -> None:
    """Put another file's content here, of whatever kind."""
    others = [other for other in sorted(file.parent.rglob("*")) if other.is_file()]
    file.write_bytes(chance.choice(others).read_bytes())


def take_away(chance: random.Random, file: Path) -> None:
    """Delete the file; or put a folder, a link to nowhere or to itself, or a pipe in its place."""
    file.unlink()
    put = (file.mkdir, lambda: file.symlink_to("nowhere"), lambda: file.symlink_to(file), lambda: os.mkfifo(file))
    number = chance.randrange(6)
    if number < len(put):
        put[number]()


def rename(chance: random.Random, file: Path) -> None:
    """Give it another number, ending or a name that is hard to say."""
    name = chance.choice((f"7{file.name}", f"{file.stem}.png", f"{file.stem} \u00e4\u4e2d{file.suffix}", "x" * 200))
    target = file.with_name(name)
    if not target.exists():
        file.rename(target)


OF_BYTES = (cut_off, change_bytes, change_bytes, replace_number, replace_number, replace_number, shuffle_lines, hollow)
OF_FILES = (exchange, take_away, rename)


def members_of(file: Path) -> dict[str, bytes]:
    """Return the files in an archive by name; nothing for other files and for archives that are damaged already."""
    try:
        if file.suffix in _ZIPS:
            with zipfile.ZipFile(file) as zipped:
                return {name: zipped.read(name) for name in zipped.namelist()}
        if file.suffix in _TARS:
            with tarfile.open(file) as archive:
                return {m.name: archive.extractfile(m).read() for m in archive if m.isreg()}  # type: ignore[union-attr]
    except Exception:
        pass  # whatever an earlier damage has led to: it is the readers that are looked at here
    return {}


def write_members(file: Path, members: dict[str, bytes]) -> None:
    """Write an archive anew."""
    if file.suffix in _ZIPS:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
            for name, content in members.items():
                zipped.writestr(name, content)
        return
    with tarfile.open(file, "w" if file.suffix == ".tar" else "w:gz") as archive:
        for name, content in members.items():
            header = tarfile.TarInfo(name)
            header.size = len(content)
            archive.addfile(header, io.BytesIO(content))


def damaged(number: int, template: Path, scratch: Path) -> str:
    """Copy a template to `scratch` and damage it; return what was done."""
    chance = random.Random(number)
    shutil.copytree(template, scratch, symlinks=True)
    done = []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        files = [file for file in sorted(scratch.rglob("*")) if file.is_file() and not file.is_symlink()]
        if not files:
            break
        # Few files say what a data set is, many are frames: let the former have their turn.
        kind = chance.choice(sorted({file.suffix for file in files}))
        file = chance.choice([file for file in files if file.suffix == kind])
        members = members_of(file) if chance.random() < 0.5 else {}
        of_bytes, of_file = chance.choice(OF_BYTES), chance.choice(OF_FILES)
        name = file.relative_to(scratch)
        if members:
            member = chance.choice(sorted(members))
            members[member] = of_bytes(chance, members[member])
            write_members(file, members)
            done.append(f"{of_bytes.__name__} {member} in {name}")
        elif chance.random() < len(OF_FILES) / (len(OF_BYTES) + len(OF_FILES)):
            of_file(chance, file)
            done.append(f"{of_file.__name__} {name}")
        else:
            file.write_bytes(of_bytes(chance, file.read_bytes()))
            done.append(f"{of_bytes.__name__} {name}")
    return ", ".join(done)


# ---- readers


def read_all(path: Path) -> None:
    """Open an input as a user would, and read all that there is; success or a `ScopemapError`."""
    sequence = open_sequence(path, size=(48, 40))
    reference_trajectory(sequence)
    masks = None if sequence.source.masks is None else MaskFiles(sequence.source.masks, sequence.rectifier)
    for frame, _ in sequence:
        if masks is not None:
            masks.covered(frame.index)
    check(survey(sequence))
    try:
        files = FilesDepth(path if path.is_dir() else path.parent, sequence.depth_rectifier, DepthSettings())
        for frame in sequence.frames():
            files.estimate(frame)
    except ScopemapError:
        pass  # most inputs hold no depth files; what they do hold is read as such none the less


def read_settings(file: Path) -> None:
    """Read a file of settings or a plan; a pipe is waited for: a shell may write the settings to it."""
    if not file.is_fifo():
        read_plan(file) if "plan" in file.name else Config.load(file=file)


def read_result(folder: Path) -> None:
    """Read a run's folder as its report and `verify` do."""
    depth = DepthReader(folder)
    for index in range(3):
        depth.read_sigma(index)
    RunFolder(folder).checked()
    verify_result(folder)


def each(read: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return what reads every file of a folder; the first that is refused does not hide the others."""

    def read_files(folder: Path) -> None:
        refused = None
        for file in sorted(folder.iterdir()):
            try:
                read(file)
            except ScopemapError as error:
                refused = error
        if refused is not None:
            raise refused

    return read_files


READERS: dict[str, Callable[[Path], None]] = {
    "calibrations": each(lambda file: read_calibration(file, (640, 480))),
    "trajectories": each(lambda file: read_trajectory(file, kind="open3d" if file.suffix == ".log" else "auto")),
    "settings": each(read_settings),
    "result": read_result,
}
"""What is opened by other doors than `open_sequence`."""


def prepared(folder: Path, only: list[str]) -> dict[str, str]:
    """Write the templates; return their names, with what a user would open of each, relative to its folder."""
    sys.path.insert(0, str(TESTS))
    from drawn_datasets import WRITERS, write_cameras
    from drawn_run import draw_run
    from drawn_trajectories import write_settings, write_trajectories

    writers = WRITERS | {
        "calibrations": write_cameras,
        "trajectories": write_trajectories,
        "settings": write_settings,
        "result": lambda target: write_checksums(draw_run(target, pictures=False)),
    }
    entries = {}
    for name in (name for name in writers if not only or name in only):
        entry = writers[name](folder / name)
        named = isinstance(entry, Path) and entry != folder / name and name not in READERS
        entries[name] = str(entry.relative_to(folder / name)) if named else ""
    return entries


# ---- the loop


def attempt(read: Callable[[Path], None], path: Path) -> tuple[str, str]:
    """Return how reading an input ended, and the message of what was no clean end."""
    outcome, finding = _READ, ""
    # Of the processor; who waits, for a pipe, is given longer: others may be at work on this machine.
    signal.setitimer(signal.ITIMER_PROF, SLOWEST_S)
    signal.alarm(6 * SLOWEST_S)
    try:
        read(path)
    except ScopemapError:
        outcome = _REFUSED
    except TooSlowError:
        outcome, finding = _FINDING, f"more than {SLOWEST_S} s"
    except BaseException:
        outcome, finding = _FINDING, traceback.format_exc(limit=-4)
    signal.setitimer(signal.ITIMER_PROF, 0)
    signal.alarm(0)
    return outcome, finding


def work(connection: Connection, templates: Path, entries: dict[str, str], numbers: range) -> None:
    """Try each number; send (number, name, what was done), then (outcome, message of what was no clean end)."""
    warnings.simplefilter("ignore")

    def too_slow(signum: int, frame: FrameType | None) -> None:
        raise TooSlowError

    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, too_slow)
    names = list(entries)
    for number in numbers:
        name = names[number % len(names)]
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            scratch = Path(folder) / "input"
            connection.send((number, name, damaged(number, templates / name, scratch)))
            outcome, finding = attempt(READERS.get(name, read_all), scratch / entries[name])
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if peak > MOST_MEMORY_KB and not finding:
            outcome, finding = _FINDING, f"{peak >> 10} MB of memory"
        connection.send((outcome, finding))
        if peak > MOST_MEMORY_KB:
            return  # it would be found again and again: a new process goes on


def try_all(entries: dict[str, str], templates: Path, numbers: range) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Try every number; return how often each name ended how, and the findings, which are printed at once."""
    counts: Counter[tuple[str, str]] = Counter()
    findings: list[str] = []
    todo = numbers

    def note(last: tuple[int, str, str], outcome: str, message: str) -> None:
        number, name, done = last
        counts[name, outcome] += 1
        if outcome == _FINDING:
            findings.append(f"{number} ({name}: {done}):\n{message}")
            print(f"\n{findings[-1]}", file=sys.stderr, flush=True)

    while todo:
        here, there = multiprocessing.Pipe()
        process = multiprocessing.Process(target=work, args=(there, templates, entries, todo))
        process.start()
        there.close()
        last = None
        try:
            while here.poll(9 * SLOWEST_S):
                message = here.recv()
                if len(message) == 3:
                    last, todo = message, range(message[0] + 1, numbers.stop)
                else:
                    note(last, *message)
                    last = None
        except EOFError:
            pass
        process.kill()
        process.join()
        if last is not None:
            note(last, _FINDING, f"the process died or hung (exit code {process.exitcode})")
    return counts, findings


def fuzz(count: int, seed: int = 0, only: list[str] | None = None) -> tuple[Counter[str], list[str]]:
    """Damage and read so many inputs, print a table; return how often which end came, and the findings."""
    with tempfile.TemporaryDirectory() as folder:
        entries = prepared(Path(folder), only or [])
        counts, findings = try_all(entries, Path(folder), range(seed, seed + count))
    ends: Counter[str] = Counter()
    for (_, end), number in counts.items():
        ends[end] += number
    return ends, findings


def main() -> None:
    """Fuzz and print the counts; exit code 1 with findings."""
    parser = options_of(__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--again", type=int, help="only this input, of a run with the same --only")
    options = parser.parse_args()
    first = options.seed * 10_000_000 if options.again is None else options.again
    ends, findings = fuzz(options.count if options.again is None else 1, first, options.only)
    print_head(*ends)
    print_row(*ends.values())
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
