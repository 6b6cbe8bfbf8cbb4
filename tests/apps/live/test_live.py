"""Live sources and sessions: the newest frame counts, what may be asked of a session, what it sends."""

from __future__ import annotations

import json
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import av
import cv2
import numpy as np
import pytest

from scopemap import Config
from scopemap.apps.live.live import LiveSession
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.input.live_source import LiveSource
from scopemap.input.opening import sequence_of
from scopemap.result.result import Result
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

FPS = 10
SETTINGS = {"input.focal": "assume", "fusion.every": 1}


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of four seconds: a phantom of 6 frames there and back, then black frames."""
    folder = tmp_path_factory.mktemp("live")
    files = sorted(write_tiny(folder / "phantom", frames=6).glob("*_color.png"))
    pictures = [cv2.imread(str(file)) for file in files]
    pictures = 3 * (pictures + pictures[::-1])
    write_video(folder / "clip.mp4", [*pictures, *4 * [np.zeros_like(pictures[0])]])
    return folder / "clip.mp4"


def write_video(file: Path, pictures: list[np.ndarray]) -> None:
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 160, 128, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())


class _Silent(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *values: Any) -> None:
        """Log nothing."""


def test_a_file_is_played_at_its_own_speed(clip: Path) -> None:
    source = LiveSource(str(clip))
    taken = [(frame.index, frame.time_s, source.now_s()) for frame in source.frames(slice(None))]
    indices = [index for index, _, _ in taken]
    assert indices == sorted(set(indices))
    assert [time_s for _, time_s, _ in taken] == pytest.approx(np.array(indices) / FPS)
    assert all(now_s >= time_s for _, time_s, now_s in taken)  # never before its time
    # A machine that others keep busy may drop one.
    assert len(indices) > 30
    assert (source.read, source.dropped) == (40, 40 - len(indices))


def test_who_is_slow_gets_the_newest_frame_and_the_others_are_counted(clip: Path) -> None:
    source, late_s, indices = LiveSource(str(clip)), [], []
    for frame in source.frames(slice(None)):
        late_s.append(source.now_s() - frame.time_s)
        indices.append(frame.index)
        time.sleep(0.3)
    assert len(indices) < 20
    assert source.dropped == 40 - len(indices)
    # A queue would be late by more with each frame: by more than a second in the end.
    assert np.median(late_s[1:]) < 0.3


def test_a_stream_is_read_as_it_comes(clip: Path, tmp_path: Path) -> None:
    with av.open(str(clip)) as read, av.open(str(tmp_path / "clip.ts"), "w", format="mpegts") as sent:
        stream = sent.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(read.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                sent.mux(packet)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Silent, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        source = LiveSource(f"http://localhost:{server.server_port}/clip.ts")
        indices = [frame.index for frame in source.frames(slice(None))]
        server.shutdown()
    assert (source.width, source.height) == (160, 128)
    # The first picture only tells the size: it is old by the time that frames are asked for.
    assert source.read == 39
    assert indices[-1] == 38
    assert source.warnings == []


def test_a_camera_is_read_until_it_gives_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    blue = np.zeros((96, 128, 3), np.uint8)
    blue[..., 0] = 200
    camera = MagicMock()
    camera.return_value.read.side_effect = [*[(True, blue)] * 3, (False, None)]
    monkeypatch.setattr(cv2, "VideoCapture", camera)
    source = LiveSource("7")
    frames = list(source.frames(slice(None)))
    camera.assert_called_once_with(7)
    assert frames[-1].rgb[0, 0].tolist() == [0, 0, 200]
    assert source.read == 2
    camera.return_value.release.assert_called()
    assert source.warnings == ["reading 7: the camera gives no more pictures"]


def test_what_is_no_source_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no such file or folder" in refused(capfd, "live", tmp_path / "none.mp4")
    assert "reading rtsp://localhost:1/x" in refused(capfd, "live", "rtsp://localhost:1/x")


# ---- sessions


def session_of(clip: Path, snapshots: Path, observer: Callable[[Any, Any], None]) -> LiveSession:
    source, config = LiveSource(str(clip)), Config.load("realtime", settings=SETTINGS)
    sequence = sequence_of(source, settings=config.input)
    return LiveSession(source, sequence, config, observers=(observer,), snapshots=snapshots)


def test_a_session_tracks_and_says_when_it_is_lost(clip: Path, tmp_path: Path) -> None:
    words: list[str] = []
    session = session_of(clip, tmp_path, lambda step, _: words.append(session.status().words))
    assert session.status().state == "starting"
    result = session.run().result()
    status = session.status()
    assert words[1] == "tracking"
    assert words[-1] == "lost: move back slowly"
    assert status.state == "ended"
    assert status.tracked + status.lost == len(result.trajectory) == status.read - status.dropped
    assert 0 < status.latency_p50_ms <= status.latency_p95_ms
    assert len(result.mesh.faces) > 100
    json.dumps(asdict(status))


def test_no_frame_waits_for_more_than_the_one_before_where_the_machine_is_slow(clip: Path, tmp_path: Path) -> None:
    late_s: list[float] = []

    def slow(step: Any, _: Any) -> None:
        late_s.append(session._source.now_s() - step.frame.time_s)
        time.sleep(0.3)

    session = session_of(clip, tmp_path, slow)
    session.run()
    # A frame waits .3 s for the one before; one in each of the four stages would be 1.2 s late.
    assert np.median(late_s[4:]) < 0.6


def test_a_reset_forgets_and_a_snapshot_is_kept(clip: Path, tmp_path: Path) -> None:
    def ask(step: Any, _: Any) -> None:
        if not session.status().snapshot:
            session.snapshot()
        elif not asked:
            asked.append(step.frame.index)
            session.pause()
            session.reset()

    asked: list[int] = []
    session = session_of(clip, tmp_path / "snapshots", ask)
    result = session.run().result()
    assert asked
    assert result.trajectory.indices[0] > asked[0]
    assert session.status().tracked + session.status().lost == len(result.trajectory)
    assert result.trajectory.status[0] == "initial"
    snapshot = Path(session.status().snapshot)
    assert cv2.imread(str(snapshot)).shape == (128, 160, 3)
    assert snapshot.with_suffix(".ply").stat().st_size > 1000
    facts = json.loads(snapshot.with_suffix(".json").read_text())
    assert np.shape(facts["T_world_camera"]) == (4, 4)


def test_the_command_writes_a_result(clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert call("live", clip, "--out", out, "--set", "fusion.every=1") == 0
    said = capfd.readouterr()
    assert f"Open {out / 'report.html'}" in said.out
    assert ("ended: " in said.err, said.out.count("ended: ")) == (False, 1)
    assert {"trajectory.tum", "mesh.ply", "report.html", "frames.csv", "SHA256SUMS"} <= {
        file.name for file in out.iterdir()
    }
    result = Result(out)
    assert result.config.mapping.method == "realtime"
    kept = [index for index in result.trajectory.indices.tolist() if result.depth.has(index)]
    assert len(kept) >= 3
    assert call("live", clip, "--json", "--seconds", 2.5) == 0
    facts = json.loads(capfd.readouterr().out)
    assert facts["live"]["read"] < 40
    assert not [notice for notice in facts["notices"] if notice["code"] == "mapping-adjusted"]
    assert "overwrite" in refused(capfd, "live", clip, "--out", out)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_keys_of_a_terminal_call_their_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    from scopemap.terminal.terminal_keys import terminal_keys

    keyboard, terminal = os.openpty()
    pressed: list[str] = []
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        with terminal_keys({"p": lambda: pressed.append("p"), "s": lambda: pressed.append("s")}) as works:
            assert works
            os.write(keyboard, b"pxs")
            end = time.monotonic() + 5
            while len(pressed) < 2 and time.monotonic() < end:
                time.sleep(0.02)
    os.close(keyboard)
    assert pressed == ["p", "s"]


# ---- OpenIGTLink


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:
    pyigtl = pytest.importorskip("pyigtl", reason="the extra igtl is not installed")
    from scopemap.apps.live.igtl import IgtlServer

    class Surface(pyigtl.messages.PolyDataMessage):
        """Reads what pyigtl 0.3.4 can write and not read."""

        def _unpack_content(self, content: bytes) -> None:
            points, *counts = struct.unpack(">10I", content[:40])
            self.points = np.frombuffer(content, ">f4", 3 * points, 40).reshape(-1, 3)
            self.polygons = np.frombuffer(content, ">u4", counts[5] // 4, 40 + 12 * points)

    monkeypatch.setitem(pyigtl.messages.message_type_to_class_constructor, "POLYDATA", Surface)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    server = IgtlServer(port)
    client = pyigtl.OpenIGTLinkClient("localhost", port)
    end = time.monotonic() + 5
    while not (server.connected and client.is_connected()) and time.monotonic() < end:
        time.sleep(0.02)
    yield server, client
    client.stop()
    server.close()


def test_pose_picture_and_surface_arrive_in_ras(link: tuple[Any, Any]) -> None:
    server, client = link
    camera = PinholeCamera(20.0, 25.0, 15.5, 11.5, 32, 24)
    rgb = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    server.send_frame(rgb, camera, T, "")
    pose = client.wait_for_message("CameraToWorld", 5)
    assert (pose.matrix @ [4, 5, 6, 1]).tolist() == [-5, -7, 9, 1]  # the point (5, 7, 9) of our world
    picture = client.wait_for_message("Image_Camera", 5)
    np.testing.assert_array_equal(picture.image[0], rgb)
    np.testing.assert_allclose(picture.ijk_to_world_matrix @ [15.5, 11.5, 0, 1], [0, 0, 10, 1], atol=1e-5)
    corner = camera.unproject(np.array([31.0, 0.0])) * 10
    np.testing.assert_allclose((picture.ijk_to_world_matrix @ [31, 0, 0, 1])[:3], corner, atol=1e-5)
    assert client.wait_for_message("Status", 5).string == "tracking"
    server.send_surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 5]]), np.array([[0, 1, 2]]))
    surface = client.wait_for_message("Surface_World", 5)
    assert surface.points.tolist() == [[0, 0, 0], [-1, 0, 0], [0, -2, 5]]
    assert surface.polygons.tolist() == [3, 0, 1, 2]
    server.send_frame(rgb, camera, None, "too dark")
    assert client.wait_for_message("Status", 5).string == "lost: too dark"
    assert client.wait_for_message("CameraToWorld", 0.2) is None


def test_a_port_that_is_taken_is_refused(link: tuple[Any, Any], clip: Path, capfd: pytest.CaptureFixture[str]) -> None:
    port = link[0]._server.port
    assert f"cannot send on port {port}" in refused(capfd, "live", clip, "--igtl", port)
