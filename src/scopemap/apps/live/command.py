"""`scopemap live`: a camera, a stream, or a file at its own speed, reconstructed as it comes."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scopemap.terminal import options
from scopemap.terminal.figures import print_json, print_warnings
from scopemap.terminal.interruption import Interruption
from scopemap.terminal.terminal_keys import terminal_keys

if TYPE_CHECKING:
    from scopemap.apps.live.live import LiveSession
    from scopemap.apps.live.live_status import LiveStatus
    from scopemap.engine.config import Config
    from scopemap.engine.odometry import Step
    from scopemap.runner.reconstructor import Reconstructor

_SHOWN_EVERY_S = 0.5
_LINE_EVERY_S = 10.0
_SURFACE_EVERY_S = 5.0
_SENT_FACES = 20_000


def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="Camera number, device (/dev/video0), address (rtsp://...), or video file played in real time.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the result, written at the end; default: none is written.")
    ] = None,
    in_app: Annotated[
        bool, typer.Option("--app", help="Show the session in a browser while it goes on, and its result (extra app).")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, metavar="PORT", help="Port of the page of --app; default: any free one."),
    ] = None,
    igtl: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, metavar="PORT", help="Send pose, image and surface to 3D Slicer or PLUS (extra igtl)."
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Stop after this many seconds; default: at the end of the stream.")
    ] = None,
    camera: options.CameraFile = None,
    fov: options.FieldOfView = None,
    scope: options.Scope = None,
    near_far: options.NearFar = None,
    size: options.Size = None,
    settings: options.SetPairs = None,
    overwrite: options.Overwrite = False,
    watched: Annotated[bool, typer.Option("--watched", hidden=True, help="Write what the window shows.")] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Reconstruct a live stream; drop frames to keep latency low.

    Keys: p pauses, r discards everything and starts again, s writes a snapshot, q stops. Ctrl-C also stops and writes
    the result; a second Ctrl-C writes nothing.
    """
    if port is not None and not in_app:
        raise typer.BadParameter("it is that of --app", param_hint="--port")
    config = _config(near_far, scope, settings or [], writes=out is not None)

    from scopemap.apps.coverage.live_map import KeptDepth, LiveCoverage
    from scopemap.apps.live.live import LiveSession, finished
    from scopemap.apps.live.live_status import ShownSession
    from scopemap.input.live_source import LiveSource
    from scopemap.input.opening import sequence_of
    from scopemap.report.frame_pictures import FramePictures
    from scopemap.report.page import write_report
    from scopemap.result.checksums import write_checksums
    from scopemap.result.result_folder import NOT_OF_THE_RESULT, result_folder

    silent, pictures, actions = quiet or as_json, FramePictures(), dict[str, Callable[[], None]]()
    reading, working = LiveSource(source), options.parse_size(size) if size else None
    sequence = sequence_of(reading, camera=camera, fov_deg=fov, size=working, settings=config.input)
    with _seen_in(out, actions, port or 0, in_app=in_app, watched=watched) as view:
        with ExitStack() as stack:
            sender = stack.enter_context(_sender(igtl, silent=silent))
            folder = stack.enter_context(result_folder(out, overwrite=overwrite))
            interruption = stack.enter_context(Interruption(reading.stop))

            def observe(step: Step, _: Reconstructor) -> None:
                interruption.observe(step)
                if folder is not None:
                    pictures(step)

            kept = KeptDepth(Path(stack.enter_context(TemporaryDirectory())))
            covered = stack.enter_context(LiveCoverage(kept))
            shown = None if view is None else ShownSession(view, covered, writes=out is not None)
            observers = observe, *([kept.observe] if folder or shown else [])
            observers += (covered.observe, shown.observe) if shown else ()
            snapshots = (folder or Path("scopemap-live")) / "snapshots"
            session = LiveSession(reading, sequence, config, followers=sender, observers=observers, snapshots=snapshots)
            actions |= {
                "pause": session.pause,
                "reset": session.reset,
                "snapshot": session.snapshot,
                "stop": session.stop,
            }
            if shown is not None:
                stack.enter_context(shown.watch(session.status))
            stack.enter_context(_controls(session, seconds, silent=silent))
            reconstructor = session.run()
            covered.settle()  # it reads the depth that is corrected now
            result = finished(reconstructor, reading, kept.final if folder is not None else None)
            if folder is not None:
                result.save(folder)
                pictures.save(folder)
                kept.move_to(folder)
                write_checksums(folder, without=NOT_OF_THE_RESULT)
        if out is not None:
            write_report(out)
        if not silent:
            _print(result.provenance, session.status(), out)
        elif as_json:
            print_json(result.provenance | {"live": asdict(status := session.status()) | {"words": status.words}})
    if interruption.exit_code:
        raise typer.Exit(interruption.exit_code)


def _config(near_far: str | None, scope: str | None, settings: list[str], *, writes: bool) -> Config:
    """Return the settings; writes : whether a result is written, for which all keyframes are adjusted at the end."""
    from scopemap.engine.config import Config

    chosen: dict[str, Any] = {"depth.near_far_mm": options.parse_near_far(near_far)} if near_far else {}
    chosen |= {"input.scope": scope} if scope else {}
    chosen |= {} if writes else {"mapping.method": "local"}
    return Config.load("realtime", settings=chosen | {"input.focal": "assume"} | options.parse_settings(settings))


@contextmanager
def _seen_in(
    out: Path | None, actions: Mapping[str, Callable[[], None]], port: int, *, in_app: bool, watched: bool
) -> Iterator[Path | None]:
    """Context in which the session is seen in the yielded folder, and lines from there call actions; None: it is not.

    in_app : in a window that this command opens. watched : in one that has started this command, and writes to it.
    """
    if watched and out is not None:
        from scopemap.result.run_view import view_folder

        threading.Thread(target=_listen, args=(actions,), name="lines", daemon=True).start()
        yield view_folder(out)
    elif in_app:
        from scopemap.terminal.window_beside import window_beside

        with TemporaryDirectory(prefix="scopemap-live-") as folder:
            arguments = ("--live", "--port", str(port))
            with window_beside(out, Path(folder), actions, arguments, partial(typer.echo, err=True)):
                yield Path(folder)
    else:
        yield None


def _listen(actions: Mapping[str, Callable[[], None]]) -> None:
    """Call the actions whose names come by standard input, and stop where it ends: nobody watches any more."""
    from scopemap.terminal.window_beside import lines_of_input

    for line in lines_of_input():
        actions.get(line.strip(), lambda: None)()
    actions.get("stop", lambda: None)()


@contextmanager
def _sender(port: int | None, *, silent: bool) -> Iterator[tuple[Callable[[Step, Reconstructor], None], ...]]:
    """Yield the observer that sends each step by OpenIGTLink, and the surface now and then; none without a port."""
    if port is None:
        yield ()
        return
    from scopemap.apps.live.igtl import IgtlServer
    from scopemap.report.shown_mesh import simplified

    server, sent_s = IgtlServer(port), time.monotonic()

    def send(step: Step, reconstructor: Reconstructor) -> None:
        nonlocal sent_s
        frame, lost = step.frame, step.track.reason if step.track.status == "lost" else ""
        server.send_frame(frame.rgb, frame.camera, frame.T_world_camera, lost)
        if server.connected and time.monotonic() - sent_s > _SURFACE_EVERY_S:
            surface = simplified(reconstructor.surface(), _SENT_FACES)
            server.send_surface(surface.vertices, surface.faces)
            sent_s = time.monotonic()

    if not silent:
        typer.echo(f"sending by OpenIGTLink on port {port} of localhost", err=True)
    try:
        yield (send,)
    finally:
        server.close()


@contextmanager
def _controls(session: LiveSession, seconds: float | None, *, silent: bool) -> Iterator[None]:
    """Context in which a session is shown, controlled by keys, and ended after some seconds."""
    keys = {"p": session.pause, "r": session.reset, "s": session.snapshot, "q": session.stop}
    ended = threading.Event()
    with ExitStack() as stack:
        if seconds is not None:
            timer = threading.Timer(seconds, session.stop)
            timer.start()
            stack.callback(timer.cancel)
        has_keys = stack.enter_context(terminal_keys(keys))
        if not silent:
            if has_keys:
                typer.echo("p pause, r reset, s snapshot, q stop", err=True)
            thread = threading.Thread(target=_show, args=(session, ended), name="show", daemon=True)
            thread.start()
            stack.callback(thread.join)
        stack.callback(ended.set)
        yield


def _show(session: LiveSession, ended: threading.Event) -> None:
    """Show a session's status until it ends: in one line of a terminal, else every ten seconds and at changes."""
    terminal, shown, shown_s = sys.stderr.isatty(), "", 0.0
    while not ended.wait(_SHOWN_EVERY_S):
        if (status := session.status()).state == "ended":  # the summary says so, once
            continue
        if terminal:
            sys.stderr.write("\r\033[K" + status.line[:100])
            sys.stderr.flush()
        elif status.state != shown or time.monotonic() - shown_s > _LINE_EVERY_S:
            typer.echo(status.line, err=True)
            shown, shown_s = status.state, time.monotonic()
    if terminal:
        sys.stderr.write("\n")


def _print(provenance: dict[str, Any], status: LiveStatus, out: Path | None) -> None:
    print_warnings(provenance)
    typer.echo(f"{provenance['tracked']} of {provenance['frames']} frames tracked, {provenance['lost']} lost")
    typer.echo(status.line)
    if out is not None:
        typer.echo(f"Open {out / 'report.html'} in a browser. All files of the result are in {out}.")
