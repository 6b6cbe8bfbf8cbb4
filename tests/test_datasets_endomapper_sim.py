"""EndoMapper's simulated sequences: pictures, the depth buffer in OpenEXR, poses in Unity's axes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap_bench.datasets import endomapper_sim
from scopemap_bench.datasets.endomapper_sim import read_exr_red

SIZE = (96, 72)
FRAMES = 4
HEADER = "tX;tY;tZ;rX;rY;rZ;rW;time(s)"
# As stored, left-handed and y up: a turn of 0.4 rad about x, then about y, then about z, then none.
AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]


def quaternion(frame: int) -> list[float]:
    return [*(np.sin(0.2) * np.array(AXES[frame])), 1.0 if frame == 3 else np.cos(0.2)]


def expected_pose(frame: int) -> np.ndarray:
    """Mirrored in y: turns about x and z change their sense, those about y stay; dm become mm."""
    c, s = np.cos(0.4), np.sin(0.4)
    turns = ([[1, 0, 0], [0, c, s], [0, -s, c]], [[c, 0, s], [0, 1, 0], [-s, 0, c]], [[c, s, 0], [-s, c, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = turns[frame] if frame < 3 else np.eye(3)
    T[:3, 3] = [10 * frame, -20, 30]
    return T


def row(frame: int) -> str:
    numbers = [0.1 * frame, 0.2, 0.3, *quaternion(frame), frame / 30]
    return ";".join(f"{value:.9g}" for value in numbers)


def buffer(size: tuple[int, int] = SIZE) -> np.ndarray:
    v = np.full((size[1], size[0]), 0.1, np.float32)
    v[0], v[1], v[2], v[3] = 0.0, 1.0, np.nan, 1.5
    v[4] = np.linspace(0, 1, size[0])
    return v


def write_exr(file: Path, channels: dict[str, np.ndarray], half: bool = False) -> bytes:
    """Write an uncompressed OpenEXR file of lines by its layout; its channels stand in alphabetical order."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    kind, dtype = (1, "<f2") if half else (2, "<f4")
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        *(
            (
                "channels",
                "chlist",
                b"".join(f"{n}\0".encode() + struct.pack("<4i", kind, 0, 1, 1) for n in names) + b"\0",
            ),
        ),
        *(("compression", "compression", b"\0"), ("dataWindow", "box2i", window), ("displayWindow", "box2i", window)),
        *(("lineOrder", "lineOrder", b"\0"), ("pixelAspectRatio", "float", struct.pack("<f", 1))),
        *(("screenWindowCenter", "v2f", bytes(8)), ("screenWindowWidth", "float", struct.pack("<f", 1))),
    )
    content = struct.pack("<2i", 20000630, 2)
    content += b"".join(f"{n}\0{t}\0".encode() + struct.pack("<i", len(v)) + v for n, t, v in attributes) + b"\0"
    lines = [b"".join(channels[name][y].astype(dtype).tobytes() for name in names) for y in range(height)]
    first, each = len(content) + 8 * height, 8 + len(lines[0])
    content += b"".join(struct.pack("<Q", first + y * each) for y in range(height))
    content += b"".join(struct.pack("<2i", y, len(line)) + line for y, line in enumerate(lines))
    file.write_bytes(content)
    return content


def write_depth(file: Path, v: np.ndarray) -> None:
    write_exr(file, {"R": v, "G": np.zeros_like(v), "B": np.zeros_like(v), "A": np.ones_like(v)})


def write_sim(folder: Path, first: int = 0) -> Path:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(first, FRAMES):
        save(folder / "rgb" / f"image_{i:04d}.png", picture(i, SIZE))
        write_depth(folder / "depth" / f"aov_image_{i:04d}.exr", buffer())
    (folder / "trajectory.csv").write_text("\n".join([HEADER, *map(row, range(FRAMES))]) + "\n")
    (folder / "info.txt").write_text("Depth image metric unities: dm\n")
    return folder


def test_a_sequence(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Simulated Sequences" / "Seq_0" / "Seq_0")
    for path in (folder, folder.parent, tmp_path):
        sequence = open_sequence(path)
        assert (sequence.source.name, sequence.path, sequence.count) == ("endomapper-sim", folder, FRAMES)
    # A tenth of 960x720: a centre c moves to (c + 0.5) / 10 - 0.5.
    np.testing.assert_allclose(sequence.camera.matrix, [[47.264955, 0, 47.5], [0, 47.264955, 35.5], [0, 0, 1]])
    for (frame, truth), number in zip(sequence, range(FRAMES), strict=True):
        assert frame.index == number_in(frame.rgb) == number
        assert frame.time_s == pytest.approx(number / 30)
        np.testing.assert_allclose(truth.T_world_camera, expected_pose(number), atol=1e-6)
        assert (truth.quality, truth.depth_mm.dtype) == ("exact", np.float32)
        # Near is 0.01 dm, far 4 dm; 1 / (0.25 + 9.975) dm lies between.
        np.testing.assert_allclose(truth.depth_mm[0], 400, rtol=1e-6)
        np.testing.assert_allclose(truth.depth_mm[1], 1.0, rtol=1e-6)
        assert np.isnan(truth.depth_mm[2:4]).all()
        np.testing.assert_allclose(truth.depth_mm[5:], 9.7799511, rtol=1e-6)
    assert sequence.source.masks is None
    assert sequence.warnings == []
    assert any("taken as Unity's left-handed axes" in note for note in sequence.notes)
    assert any("time stamps: those of trajectory.csv" in note for note in sequence.notes)


def test_numbers_are_those_of_the_rows_also_in_a_part(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0", first=2)
    reference = reference_trajectory(open_sequence(folder))
    np.testing.assert_array_equal(reference.indices, [2, 3])
    np.testing.assert_allclose(reference.T_world_camera, [expected_pose(2), expected_pose(3)], atol=1e-6)
    np.testing.assert_allclose(reference.times_s, [2 / 30, 3 / 30])


def test_the_calibration_that_was_downloaded_and_ones_own(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    text = "fx: 500\nfy: 501\ncx: 470\ncy: 350\n\ncols: 960\nrows: 720\n"
    (folder / "calibration.txt").write_text(text)
    expected = [[50, 0, 46.55], [0, 50.1, 34.55], [0, 0, 1]]
    np.testing.assert_allclose(open_sequence(folder).camera.matrix, expected)
    write_calibration(PinholeCamera(60.0, 60.0, 48.0, 36.0, *SIZE), folder / "camera.yaml", depth_scale_mm=10.0)
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 60.0
    assert sequence.source.truth(0).depth_mm[0, 0] == pytest.approx(40.0)


def test_a_last_row_that_breaks_off_is_left_out(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    (folder / "trajectory.csv").write_text("\n".join([HEADER, *map(row, range(3)), row(3)[:15]]))
    sequence = open_sequence(folder)
    assert [sequence.source.pose(i) is None for i in range(FRAMES)] == [False, False, False, True]
    assert any("line 5" in w and "the last row is cut off and was left out" in w for w in sequence.warnings)
    assert any("1 of 4 images have no pose" in warning for warning in sequence.warnings)
    np.testing.assert_allclose([frame.time_s for frame in sequence.frames()], np.arange(4) / 30, atol=1e-8)


def test_a_frame_without_a_pose_keeps_its_depth(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    rows = [HEADER, row(0), "nan;" + row(1).partition(";")[2], row(2), row(3)]
    (folder / "trajectory.csv").write_text("\n".join(rows))
    sequence = open_sequence(folder)
    assert sequence.source.pose(1) is None
    assert sequence.source.truth(1).depth_mm is not None
    np.testing.assert_array_equal(reference_trajectory(sequence).indices, [0, 2, 3])


def test_times_that_do_not_increase_are_left_out(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    rows = [HEADER, *(row(i).rpartition(";")[0] + ";0.5" for i in range(FRAMES))]
    (folder / "trajectory.csv").write_text("\n".join(rows))
    sequence = open_sequence(folder)
    np.testing.assert_allclose([time for _, time in sequence.source.stamps(slice(None))], np.arange(FRAMES) / 30)
    assert any("the times do not increase" in warning for warning in sequence.warnings)


def test_without_a_decoder_there_is_no_depth_and_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endomapper_sim, "find_spec", lambda name: None)
    sequence = open_sequence(write_sim(tmp_path / "Seq_0"))
    assert sequence.source.truth(0).depth_mm is None
    assert any("pip install -e bench" in warning for warning in sequence.warnings)


# ---- OpenEXR


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("names", ["RGB", "ABGR", "Y"])
def test_the_red_channel_is_read_exactly(half: bool, names: str, tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((40, 50)).astype(np.float16 if half else np.float32)
    write_exr(tmp_path / "a.exr", {name: values if name in "RY" else values + 1 for name in names}, half)
    read = read_exr_red(tmp_path / "a.exr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values.astype(np.float32))


def test_an_exr_file_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "a.exr"
    whole = write_exr(file, {"R": buffer(), "G": buffer(), "B": buffer()})
    window, large = struct.pack("<4i", 0, 0, 95, 71), struct.pack("<4i", 0, 0, 99999, 99999)
    damaged = {
        "empty": b"",
        "text": b"no picture at all",
        "cut in the header": whole[:60],
        "cut in the lines": whole[: len(whole) // 2],
        "cut at the end": whole[:-1],
        "of no size": whole.replace(window, struct.pack("<4i", 0, 0, -1, 71)),
        "without a window": whole.replace(b"dataWindow", b"dataWindov"),
    }
    for name, content in damaged.items():
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.exr: no OpenEXR image") as caught:
            read_exr_red(file)
        assert "\n" not in str(caught.value), name
    file.write_bytes(whole.replace(window, large))
    with pytest.raises(InputError, match=r"a\.exr: .*more than 64 million pixels"):
        read_exr_red(file)
    write_exr(file, {"G": buffer()})
    with pytest.raises(InputError, match="with a channel R or Y"):
        read_exr_red(file)


# ---- faults


def test_depth_of_another_aspect_is_refused_and_of_another_size_is_not(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    write_depth(folder / "depth" / "aov_image_0001.exr", buffer((48, 36)))
    write_depth(folder / "depth" / "aov_image_0002.exr", buffer((48, 48)))
    sequence = open_sequence(folder)
    assert sequence.source.truth(1).depth_mm.shape == (36, 48)
    with pytest.raises(InputError, match=r"aov_image_0002\.exr: depth of 48x48 px for images of 96x72 px"):
        sequence.source.truth(2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose"),
        (f"{HEADER}\n", "holds no pose"),
        (f"{HEADER}\n1;2\n", "line 2: found 2 columns"),
        (f"{HEADER}\n1;2\n{row(1)}\n", "line 2: found 2 columns where 8"),
        (f"{HEADER}\n{row(0)}\n\n{row(1)}\n", "line 3: found 0 columns"),
        (f"{HEADER}\n{row(0)};7\n{row(1)}\n", "line 2: found 9 columns"),
        (f"{HEADER}\na{row(0)}\n{row(1)}\n", "line 2: could not convert"),
        (f"{HEADER}\n0;0;0;0;0;0;0;0\n{row(1)}\n", "line 2: the quaternion has length 0"),
        (b"\xff\xfe\x00", "cannot read"),
    ],
)
def test_a_trajectory_that_is_none_is_one_sentence(text: str | bytes, message: str, tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    (folder / "trajectory.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "trajectory.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nothing_to_read_and_no_trajectory(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    (folder / "trajectory.csv").unlink()
    with pytest.raises(InputError, match=r"trajectory\.csv"):
        endomapper_sim.EndoMapperSimFolder(folder)
    with pytest.raises(InputError, match="there is no image"):
        endomapper_sim.EndoMapperSimFolder(tmp_path)
