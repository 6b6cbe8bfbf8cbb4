"""Nothing leaves the machine: no command asks for a network or leaves anything in the user's folders.

Commands run in a process that is ended by the kernel when it, a worker or a native library opens a socket
(`quiet_process.py`), in an empty home. What the runtime of the networks does before its first packet shows there: it
writes an identity and a queue of events, and sends them seconds later, longer than most commands here take.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from functools import cache, partial
from pathlib import Path
from urllib.request import urlopen

import pytest
import typer.main

from scopemap.cli.app import app
from tests.support import quiet_process
from tests.support.drawn_boards import CHECKERBOARD, PINHOLE, Studio
from tests.support.drawn_clips import clip, write
from tests.support.drawn_inputs import save
from tests.support.tiny_phantom import only_images, write_tiny

pytestmark = pytest.mark.slow

# Of the environment, for nothing else may switch telemetry off: the runtime is quiet where it finds a CI's variables.
KEPT = {"PATH", "SYSTEMROOT", "LANG", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR"}
# Each command says its name before it begins: what ends the process is that of the last one named.
MANY = """
import shlex, sys
from functools import partial
from scopemap.apps.demo import demo
from scopemap.cli.app import app
demo.run_clip = partial(demo.run_clip, frames=slice(0, 8))
for command in sys.argv[1:]:
    print(command, file=sys.stderr, flush=True)
    app(shlex.split(command), prog_name="scopemap", standalone_mode=False)
"""
ONE = "import sys; from scopemap.cli.app import main; main()"
CLOSED = (
    *("run in --out other", "inspect clip.mp4", "demo --out demo"),
    "batch in clip.mp4 --frames 0:4 --out batch --workers 2",
    *("report run", "verify run", "evaluate run --truth tiny", "evaluate run --against-video"),
    *("export run --to colmap --out colmap", "export run --to glb --out a.glb", "export run --to mcap --out a.mcap"),
    "calibrate board --board 9x6 --square-mm 3 --model pinhole",
    "measure run --frame 2 --points '60,60 90,90' --reference '60,60 90,60'",
    *("locate run tiny --out located.csv", "coverage run --out covered", "compare-exams run run --out both"),
    "live clip.mp4 --seconds 20 --out live",
    *("phantom made --frames 3 --size 160x128", "compare run --truth tiny --out compared"),
    *("climb run --out c --clip x", "bench", "bench speed in --frames 0:6"),
    *("datasets list", "datasets check tiny", "models list", "models verify"),
)
# pydicom imports requests, where that is installed, which binds ::1 to see whether the machine has IPv6, no more.
SERVING = ("export run --to dicom --out a.dcm",)
# They show a window until they are stopped.
WINDOWS = (("view", "run", "--no-browser"), ("app", ".", "--no-browser"))
# Where the installation cannot be written; lists of the machine's fonts; an empty folder of torch (docs/install.md).
DOCUMENTED = {"numba", "matplotlib", "fontconfig", "torchinductor_user"}


@cache
def _has_guard() -> bool:
    command = [sys.executable, quiet_process.__file__, "closed", sys.executable, "-c", ""]
    return quiet_process.HAS_GUARD and subprocess.run(command, capture_output=True, check=False).returncode == 0


def _environment(home: Path) -> dict[str, str]:
    """Return that of a user of whom nothing is known, whose folders lie in `home`."""
    (home / "tmp").mkdir(parents=True, exist_ok=True)
    known = {name: value for name, value in os.environ.items() if name in KEPT or name.startswith("SCOPEMAP_")}
    known["PYTHONPATH"] = os.pathsep.join(sys.path)
    places = dict.fromkeys(("HOME", "USERPROFILE", "LOCALAPPDATA"), str(home))
    return known | places | {"TMPDIR": str(home / "tmp"), "COLUMNS": "120", "USER": "user"}


def _start(folder: Path, code: str, *arguments: str, mode: str = "closed") -> subprocess.Popen[str]:
    """Start Python under the guard, where there is one, in an empty home."""
    guard = [sys.executable, quiet_process.__file__, mode] if _has_guard() else []
    # A job in the background of a shell ignores Ctrl-C, and so would its children.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler) if os.name == "posix" else None
    return subprocess.Popen(
        [*guard, sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=_environment(folder / "home"),
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=heed,
    )


def _left(folder: Path) -> set[str]:
    """What is in the user's folders that no document names."""
    found = {file.relative_to(folder / "home") for file in (folder / "home").rglob("*")}
    hidden = {Path(name) for name in ("tmp", ".cache", ".config")}
    return {str(file) for file in found - hidden if not DOCUMENTED & set(file.parts)}


def _assert_quiet(folder: Path, code: str, *arguments: str, mode: str = "closed", served: bool = False) -> None:
    """Run commands, and look at how they ended and at what they left. served : one shows a page until it is stopped."""
    before = _left(folder)
    with _start(folder, code, *arguments, mode=mode) as process:
        timer = threading.Timer(400, process.kill)
        timer.start()
        if served:
            assert process.stdout is not None
            url = next(word for word in process.stdout.readline().split() if word.startswith("http"))
            with urlopen(url, timeout=20) as page:
                assert page.status == 200
            process.send_signal(signal.SIGINT)
        said = process.communicate()
        timer.cancel()
    assert process.returncode != -signal.SIGSYS, f"it asked for a network: {said}"
    assert process.returncode == 0, said
    assert "SIGSYS" not in "".join(said)
    assert _left(folder) - before == set()


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a phantom, its images, a video, pictures of a board, and a run, itself made quietly."""
    folder = tmp_path_factory.mktemp("quiet")
    only_images(write_tiny(folder / "tiny", frames=12), folder / "in")  # fewer are not usable
    write(folder / "clip.mp4", clip(50))
    (folder / "board").mkdir()
    studio = Studio(PINHOLE, CHECKERBOARD)
    for number, pose in enumerate(list(studio.poses(40, seed=3))[:24]):
        save(folder / "board" / f"{number:03d}.png", studio.shot(pose, seed=number))
    _assert_quiet(folder, ONE, "run", "tiny", "--out", "run")
    return folder


def test_commands_are_quiet(desk: Path) -> None:
    _assert_quiet(desk, MANY, *CLOSED)
    _assert_quiet(desk, MANY, *SERVING, mode="serving")
    for window in WINDOWS:
        _assert_quiet(desk, ONE, *window, mode="serving", served=True)


def test_every_command_is_tried() -> None:
    tried = {command.split()[0] for command in (*CLOSED, *SERVING)} | {window[0] for window in WINDOWS}
    assert tried == set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


def test_what_is_not_quiet_is_found(tmp_path: Path) -> None:
    """The runtime writes before it sends, where nobody has switched that off."""
    with _start(tmp_path, "import onnxruntime") as process:
        process.communicate()
    assert any("onnxruntime" in name for name in _left(tmp_path))


@pytest.mark.parametrize(
    ("code", "modes"),
    [
        ("import socket; socket.create_connection(('127.0.0.1', 9))", ("closed", "serving")),
        ("import ctypes; ctypes.CDLL(None).socket(2, 1, 0)", ("closed",)),
        (
            "import ctypes as c; c.CDLL(None).getaddrinfo(b'a.invalid', None, None, c.byref(c.c_void_p()))",
            ("closed", "serving"),
        ),
        ("import socket; socket.socketpair(); socket.socket(socket.AF_UNIX)", ()),
    ],
)
def test_the_guard_ends_who_asks_for_a_network(code: str, modes: tuple[str, ...], tmp_path: Path) -> None:
    if not _has_guard():
        pytest.skip("this system has no filter of system calls (seccomp of Linux on x86-64 or ARM)")
    for mode in ("closed", "serving"):
        with _start(tmp_path, code, mode=mode) as process:
            said = process.communicate()
        assert (process.returncode == -signal.SIGSYS) == (mode in modes), said


@pytest.mark.parametrize("value", ["", "0", "1"])
def test_a_runtime_that_was_imported_before_is_named(value: str, tmp_path: Path) -> None:
    setting = f"import os; os.environ['ORT_DISABLE_TELEMETRY'] = '{value}'; "
    with _start(tmp_path, f"{setting}import onnxruntime, scopemap") as process:
        _, said = process.communicate()
    assert process.returncode == 0, said
    words = "onnxruntime was imported before scopemap and may send telemetry: import scopemap first, or set"
    assert said.count(words) == (value != "1")
    assert value != "1" or said == ""
