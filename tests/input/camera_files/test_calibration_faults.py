"""Files made to do harm: each is one sentence, at once and in little memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import CalibrationError, ScopemapError
from scopemap.input.camera_files.reading import read_calibration
from tests.support.drawn_calibrations import forms

MANY = 200_000
LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ENTITIES = (
    '<?xml version="1.0"?>\n<!DOCTYPE lolz [<!ENTITY a "' + "x" * 1000 + '">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    + "]>\n<opencv_storage><K>&i;</K></opencv_storage>"
)  # fmt: skip
OUTSIDE = '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/hostname">]><opencv_storage><K>&e;</K></opencv_storage>'
BOMBS = {
    "aliases": LAUGHS,
    "aliases of a long list": f"a: &a {[1] * 5000}\nb: [{', '.join(['*a'] * 5000)}]\n",
    "merge key": "a: &a {K: [1]}\nb:\n  <<: *a\n",
    "alias of itself": "K: &k [*k]\n",
    "entities": ENTITIES,
    "entity outside": OUTSIDE,
    "brackets": "K: " + "[" * MANY,
    "json brackets": '{"K": ' + "[" * MANY,
    "json objects": '{"K": ' * 100_000,
    "dashes": "K:\n " + "- " * MANY,
    "elements": "<opencv_storage>" + "<K>" * MANY,
    "many elements": "<opencv_storage>" + "<K/>" * MANY + "</opencv_storage>",
    "many rows": "K:\n" + "- 1\n" * MANY,
    "many names": "".join(f"n{i}:\n  m: 1\n" for i in range(60_000)),
    "one long word": "x" * 1_000_000,
    "long quote": 'K: "' + "x" * 1_000_000,
    "tags": "K: " + "!" * MANY,
    "separators": "," * 1_000_000,
    "many numbers": "1 " * 400_000,
    "long number": "K: [" + "9" * 900_000 + ", 0, 1, 0, 1, 1, 0, 0, 1]\n",
    "long whole number in json": '{"K": [' + "9" * 900_000 + "]}",
    "huge": "1e308 1e308 1e308 1e308 1e308 1e308 1e308 1e308",
    "huge polynomial": "camera_model: omnidirectional\nK: [5e2, 0, 3e2, 0, 5e2, 2e2, 0, 0, 1]\n"
    f"polynomial: {[500.0] * 10_000}\n",
    "huge size": "K: [520, 0, 318, 0, 525, 245, 0, 0, 1]\nimage_width: 1e300\nimage_height: 1e300\n",
    "nul": "K: [520, 0\0]",
    "colmap of many": "1 PINHOLE 640 480 520 520 318 245\n" * 20_000,
}
BINARY = {
    "noise": bytes(np.random.default_rng(0).integers(0, 256, 10_000, dtype=np.uint8)),
    "picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "colmap's claim": np.array([2**62, 1, 0], dtype="<u8").tobytes() + bytes(8),
    "colmap's count": np.array([20], dtype="<u8").tobytes() + np.array([1, 1], "<u4").tobytes()
    + np.array([640, 480], "<u8").tobytes() + bytes(40),
    "utf-16, cut": "520 525 318 245".encode("utf-16")[:9],
}  # fmt: skip


def refused(file: Path) -> str:
    started = time.process_time()
    with pytest.raises(ScopemapError) as caught:
        read_calibration(file, (640, 480))
    assert time.process_time() - started < 5
    message = str(caught.value)
    assert len(message) < 1000
    assert "\n" not in message
    return message


@pytest.mark.slow
@pytest.mark.parametrize("bomb", [*BOMBS, *BINARY])
def test_bombs(bomb: str, tmp_path: Path) -> None:
    (tmp_path / "bomb").write_bytes(BINARY.get(bomb) or BOMBS[bomb].encode())
    message = refused(tmp_path / "bomb")
    assert "bomb" in message
    named = {"entities": "entities", "brackets": "deep", "dashes": "deep"}
    assert named.get(bomb, "") in message


def test_a_large_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(CalibrationError, match="larger than any calibration"):
        read_calibration(tmp_path / "large.yaml", (640, 480))


def test_a_pipe_and_a_loop_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("pipe", "loop"):
        assert name in refused(tmp_path / name)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the limit of memory is Linux' own")
@pytest.mark.parametrize("bomb", ["aliases", "entities", "brackets", "elements", "many elements", "many rows"])
def test_bombs_take_little_memory(bomb: str, tmp_path: Path) -> None:
    (tmp_path / "bomb").write_text(BOMBS[bomb])
    code = (
        "import resource, sys\nfrom scopemap.input.camera_files.reading import read_calibration\n"
        "from scopemap.engine.errors import CalibrationError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n    read_calibration(sys.argv[1], (640, 480))\nexcept CalibrationError:\n"
        "    sys.exit(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before > 150_000)\n"
        "sys.exit(2)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "bomb")], check=False, timeout=60)
    assert done.returncode == 0


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(forms())), st.data())
def test_bytes_gone_wrong_end_in_a_sentence_or_a_camera(
    tmp_path_factory: pytest.TempPathFactory, form: str, data: st.DataObject
) -> None:
    content = forms()[form][0]
    damaged = bytearray(content if isinstance(content, bytes) else content.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    file = tmp_path_factory.mktemp("damaged") / "c"
    file.write_bytes(bytes(damaged[: data.draw(st.integers(1, len(damaged)))]))
    try:
        camera = read_calibration(file, (640, 480), "scale").camera
    except ScopemapError:
        return
    assert (camera.width, camera.height) == (640, 480)
    assert np.isfinite(camera.central.matrix).all()
