"""Damaged inputs: does every reader of data sets, calibrations, trajectories, settings and results end in success or in
one clear sentence?

    python -m scopemap_bench.scripts.fuzz [--count 20000] [--seed 0] [--only NAME ...] [--again NUMBER]

Takes the made-up copies of all layouts from the tests, damages one to three of their files (cut off, bytes changed,
emptied, numbers replaced, lines doubled or swapped, files taken away, exchanged or renamed; every other time a file
inside an archive, which is closed again), opens what is left as a user would and reads all of it: frames, truth, depth
files, masks, and what `datasets check` looks at. Anything that is neither success nor a `ScopemapError`, takes over
10 s of the processor or over 1 GB of memory is a finding, printed with the number that makes it again.
"""

from __future__ import annotations

import argparse
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
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[4]
sys.path.insert(0, str(ROOT / "tests"))

from drawn_datasets import WRITERS, write_cameras  # noqa: E402
from drawn_run import draw_run  # noqa: E402
from drawn_trajectories import write_settings, write_trajectories  # noqa: E402

from scopemap.actions.verifying import verify_result  # noqa: E402
from scopemap.cameras.formats.reading import read_calibration  # noqa: E402
from scopemap.config import Config, DepthSettings  # noqa: E402
from scopemap.depth.files import FilesDepth  # noqa: E402
from scopemap.errors import ScopemapError  # noqa: E402
from scopemap.io.checksums import write_checksums  # noqa: E402
from scopemap.io.depth_maps import DepthReader  # noqa: E402
from scopemap.io.opening import open_sequence  # noqa: E402
from scopemap.io.reference import reference_trajectory  # noqa: E402
from scopemap.io.run_folder import RunFolder  # noqa: E402
from scopemap.masking.mask_files import MaskFiles  # noqa: E402
from scopemap.trajectory.formats.opening import read_trajectory  # noqa: E402
from scopemap_bench.datasets.checking import check  # noqa: E402
from scopemap_bench.datasets.survey import survey  # noqa: E402
from scopemap_bench.plan import read_plan  # noqa: E402

SLOWEST_S = 10
MOST_MEMORY_KB = 1 << 20
_STRANGE = ("nan", "inf", "-inf", "-1", "0", "1e308", "1e-320", "9" * 20, "", "x", "1,5", "0x10", "\u0661")
_HOLLOW = (b"", b"\0" * 64, b"\n\n\n", b"%YAML:1.0\n---\n", b"<?xml version='1.0'?>", b"{}", b"[]")
_TARS, _ZIPS = (".gz", ".tgz", ".tar"), (".zip", ".xlsx")
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


class TooSlowError(BaseException):
    """Time is up; no reader that catches what damaged bytes end in may take this for a damage."""


Damage = Callable[[random.Random, Path], None]


def cut_off(chance: random.Random, file: Path) -> None:
    """Keep the first part only."""
    content = file.read_bytes()
    file.write_bytes(content[: chance.randrange(len(content) + 1)])


def change_bytes(chance: random.Random, file: Path) -> None:
    """Put other bytes here and there, near the beginning more often than not."""
    content = bytearray(file.read_bytes())
    reach = min(len(content), chance.choice((16, 64, 512, 1 << 30)))
    for _ in range(chance.randint(1, 8) if reach else 0):
        content[chance.randrange(reach)] = chance.choice((0, 1, 127, 128, 255, chance.randrange(256)))
    file.write_bytes(bytes(content))


def replace_number(chance: random.Random, file: Path) -> None:
    """Write something strange where a number stood."""
    content = file.read_bytes()
    places = list(_NUMBER.finditer(content[: 1 << 16]))
    if places:
        place = chance.choice(places)
        strange = chance.choice(_STRANGE).encode()
        file.write_bytes(content[: place.start()] + strange + content[place.end() :])


def shuffle_lines(chance: random.Random, file: Path) -> None:
    """Double, take away or swap lines."""
    lines = file.read_bytes().split(b"\n")
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(3):
        case 0:
            lines.insert(one, lines[other])
        case 1:
            del lines[one]
        case _:
            lines[one], lines[other] = lines[other], lines[one]
    file.write_bytes(b"\n".join(lines))


def exchange(chance: random.Random, file: Path) -> None:
    """Put another file's content here, of whatever kind."""
    others = [other for other in sorted(file.parent.rglob("*")) if other.is_file()]
    file.write_bytes(chance.choice(others).read_bytes())


def take_away(chance: random.Random, file: Path) -> None:
    """Delete the file; or put a folder, a link to nowhere or to itself, or a pipe in its place."""
    file.unlink()
    match chance.randrange(6):
        case 0:
            file.mkdir()
        case 1:
            file.symlink_to("nowhere")
        case 2:
            file.symlink_to(file)
        case 3:
            os.mkfifo(file)


def rename(chance: random.Random, file: Path) -> None:
    """Give it another number, ending or a name that is hard to say."""
    name = chance.choice((f"7{file.name}", f"{file.stem}.png", f"{file.stem} \u00e4\u4e2d{file.suffix}", "x" * 200))
    target = file.with_name(name)
    if not target.exists():
        file.rename(target)


def empty(chance: random.Random, file: Path) -> None:
    """Leave nothing, or nothing but zeros or blanks."""
    file.write_bytes(chance.choice(_HOLLOW))


TO_CONTENT: tuple[Damage, ...] = (cut_off, change_bytes, replace_number, shuffle_lines, empty)
DAMAGES: tuple[Damage, ...] = (
    *(cut_off, change_bytes, change_bytes, replace_number, replace_number, replace_number),
    *(shuffle_lines, exchange, take_away, rename, empty),
)


def damage_member(chance: random.Random, file: Path, members: dict[str, bytes]) -> str:
    """Damage one of the `members` of an archive and write it anew; return what was done to which."""
    name, damage = chance.choice(sorted(members)), chance.choice(TO_CONTENT)
    with tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / "member"
        inner.write_bytes(members[name])
        damage(chance, inner)
        members[name] = inner.read_bytes()
    if file.suffix in _ZIPS:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
            for member, content in members.items():
                zipped.writestr(member, content)
    else:
        with tarfile.open(file, "w" if file.suffix == ".tar" else "w:gz") as archive:
            for member, content in members.items():
                header = tarfile.TarInfo(member)
                header.size = len(content)
                archive.addfile(header, io.BytesIO(content))
    return f"{damage.__name__} {name} in"


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
        if members:
            what = damage_member(chance, file, members)
        else:
            damage = chance.choice(DAMAGES)
            what = damage.__name__
            damage(chance, file)
        done.append(f"{what} {file.relative_to(scratch)}")
    return ", ".join(done)


def read_all(path: Path) -> None:
    """Open an input as a user would, and read all that there is; success or a `ScopemapError`."""
    sequence = open_sequence(path, size=(48, 40))
    reference_trajectory(sequence)
    masks = None
    if sequence.source.masks is not None:
        masks = MaskFiles(sequence.source.masks, sequence.rectifier)
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


def read_cameras(folder: Path) -> None:
    """Read every calibration in a folder."""
    _each(lambda file: read_calibration(file, (640, 480)), folder)


def read_trajectories(folder: Path) -> None:
    """Read every trajectory in a folder."""
    _each(lambda file: read_trajectory(file, kind="open3d" if file.suffix == ".log" else "auto"), folder)


def read_settings(folder: Path) -> None:
    """Read every file of settings in a folder, plans too."""
    # A pipe is waited for: a shell may write the settings to it.
    read = {True: read_plan, False: lambda file: Config.load(file=file)}
    _each(lambda file: file.is_fifo() or read["plan" in file.name](file), folder)


def read_result(folder: Path) -> None:
    """Read a run's folder as its report and `verify` do."""
    depth = DepthReader(folder)
    for index in range(3):
        depth.read_sigma(index)
    RunFolder(folder).checked()
    verify_result(folder)


def _each(read: Callable[[Path], object], folder: Path) -> None:
    """Read every file or folder; the first that is refused does not hide the others."""
    refused = None
    for file in sorted(folder.iterdir()):
        try:
            read(file)
        except ScopemapError as error:
            refused = error
    if refused is not None:
        raise refused


# What is opened by other doors than `open_sequence`: its writer and its reader.
OTHERS: dict[str, tuple[Callable[[Path], None], Callable[[Path], None]]] = {
    "calibrations": (write_cameras, read_cameras),
    "trajectories": (write_trajectories, read_trajectories),
    "settings": (write_settings, read_settings),
    "result": (lambda folder: write_checksums(draw_run(folder, pictures=False)), read_result),
}


def work(connection: Connection, templates: Path, names: list[str], numbers: range) -> None:
    """Try each number; send (number, name, what was done), then ("", message of what was no clean end)."""
    warnings.simplefilter("ignore")

    def too_slow(signum: int, frame: FrameType | None) -> None:
        raise TooSlowError

    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, too_slow)
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            name = names[number % len(names)]
            scratch = Path(folder) / "input"
            done = damaged(number, templates / name, scratch)
            connection.send((number, name, done))
            verdict, finding = "success", ""
            # Of the processor; who waits, for a pipe, is given longer: others may be at work on this machine.
            signal.setitimer(signal.ITIMER_PROF, SLOWEST_S)
            signal.alarm(6 * SLOWEST_S)
            try:
                OTHERS[name][1](scratch) if name in OTHERS else read_all(_entry(templates / name, scratch))
            except ScopemapError:
                verdict = "refused"
            except TooSlowError:
                verdict, finding = "finding", f"more than {SLOWEST_S} s"
            except BaseException:
                verdict, finding = "finding", traceback.format_exc(limit=-4)
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            if peak > MOST_MEMORY_KB and not finding:
                verdict, finding = "finding", f"{peak >> 10} MB of memory"
            connection.send((verdict, finding))
            if peak > MOST_MEMORY_KB:
                return  # it would be found again and again: a new process goes on
            _removed(scratch)


def _entry(template: Path, scratch: Path) -> Path:
    """Return what a user would name: the file where there was one only, else the folder that the writer returned."""
    inner = (template.parent / f"{template.name}.entry").read_text()
    return scratch / inner if inner else scratch


def _removed(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    if folder.exists():
        raise RuntimeError(f"{folder} cannot be removed")


def prepared(folder: Path, only: list[str]) -> list[str]:
    """Write the templates; return their names."""
    names = [name for name in (*WRITERS, *OTHERS) if not only or name in only]
    for name in names:
        target = folder / name
        entry = WRITERS[name](target) if name in WRITERS else OTHERS[name][0](target) or target
        (folder / f"{name}.entry").write_text("" if entry == target else str(entry.relative_to(target)))
    return names


def fuzz(names: list[str], templates: Path, numbers: range) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Try every number; return how often each name ended how, and the findings."""
    counts: Counter[tuple[str, str]] = Counter()
    findings: list[str] = []
    started, todo = time.monotonic(), numbers
    while todo:
        here, there = multiprocessing.Pipe()
        process = multiprocessing.Process(target=work, args=(there, templates, names, todo))
        process.start()
        there.close()
        last = None
        try:
            while True:
                if not here.poll(9 * SLOWEST_S):
                    raise EOFError
                message = here.recv()
                if len(message) == 3:
                    last = message
                    continue
                number, name, done = last
                counts[name, message[0]] += 1
                if message[0] == "finding":
                    findings.append(f"{number} ({name}: {done}):\n{message[1]}")
                    print(f"\n{findings[-1]}", flush=True)
                if (number + 1 - numbers.start) % 1000 == 0:
                    spent = time.monotonic() - started
                    print(f"{number + 1 - numbers.start} inputs, {len(findings)} findings, {spent:.0f} s", flush=True)
                last, todo = None, range(number + 1, numbers.stop)
        except EOFError:
            pass
        process.kill()
        process.join()
        if last is not None:
            number, name, done = last
            counts[name, "finding"] += 1
            findings.append(f"{number} ({name}: {done}):\nthe process died or hung (exit code {process.exitcode})")
            print(f"\n{findings[-1]}", flush=True)
            todo = range(number + 1, numbers.stop)
    return counts, findings


def main() -> None:
    """Fuzz and print the counts and findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--again", type=int, help="only this input, of a run with the same --only")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        names = prepared(Path(folder), options.only)
        first = options.seed * 10_000_000 if options.again is None else options.again
        numbers = range(first, first + (options.count if options.again is None else 1))
        counts, findings = fuzz(names, Path(folder), numbers)
    print("\n| input | read | refused with a sentence | findings |\n|---|---|---|---|")
    for name in names:
        print(f"| {name} | {counts[name, 'success']} | {counts[name, 'refused']} | {counts[name, 'finding']} |")
    print(f"\n{sum(counts.values())} damaged inputs, {len(findings)} findings")
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
