"""How the made-up copies of three layouts store what a `Content` holds: numbered files, a list of files, a video."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import cv2
import numpy as np

from scopemap.input.camera_files.writing import write_calibration
from tests.support.drawn_image_sets import write_list
from tests.support.drawn_scene import RATE_HZ, Content, quaternion

Put = Callable[[Path, Content], None]


@dataclass(frozen=True)
class Kind:
    """One layout.

    puts : put all of a `Content` in the place of what a copy holds. pictures : what holds them. scale : of the scene,
    where depth is stored in coarse steps. depth_unit_mm : mm per unit of depth files, None: no depth. stamps : whether
    time stamps are stored. listed : whether a list numbers the frames.
    """

    puts: tuple[Put, ...]
    pictures: Literal["files", "video"] = "files"
    scale: float = 1.0
    depth_unit_mm: float | None = None
    stamps: bool = False
    listed: bool = False


def _table(name: str, row: Callable[[int, Content], list[float]], separator: str = " ") -> Put:
    """One row of numbers per pose, in order."""

    def put(folder: Path, content: Content) -> None:
        rows = [separator.join(f"{x:.12g}" for x in row(number, content)) for number in sorted(content.poses)]
        (folder / name).write_text("\n".join(rows) + "\n")

    return put


def _in_metres(T: np.ndarray) -> list[float]:
    return [*(T[:3, 3] * 1e-3), *quaternion(T)]


def _files(pattern: str, folder: Path, contents: dict[int, bytes]) -> None:
    for file in folder.glob(re.sub(r"\{.*?\}", "*", pattern)):
        file.unlink()
    for number, data in contents.items():
        (folder / pattern.format(number)).write_bytes(data)


def _picture_bytes(content: Content) -> dict[int, bytes]:
    images = {n: cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))[1] for n, rgb in content.rgb.items()}
    return {number: content.rgb_damage.get(number, bytes)(image.tobytes()) for number, image in images.items()}


def _pictures(pattern: str) -> Put:
    def put(folder: Path, content: Content) -> None:
        _files(pattern, folder, _picture_bytes(content))
        for number in content.names_again:
            file = folder / pattern.format(number)
            # Another name with the same last number.
            file.with_name(re.sub(r"(\d+)(?!.*\d)", r"0\1", file.name)).write_bytes(file.read_bytes())

    return put


def _stacked_movie(name: str) -> Put:
    """Pictures above those of another view, as a video that only counts them."""

    def put(folder: Path, content: Content) -> None:
        images = [np.vstack([rgb, rgb[::-1]]) for _, rgb in sorted(content.rgb.items())]
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream("mpeg4", rate=RATE_HZ)
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt, stream.gop_size, stream.bit_rate = "yuv420p", 1, 4_000_000
            for place, image in enumerate(images):
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts, frame.time_base = place, Fraction(1, RATE_HZ)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        if content.stream_damage is not None:
            (folder / name).write_bytes(content.stream_damage((folder / name).read_bytes()))

    return put


def _listed_pictures(folder: Path, content: Content) -> None:
    names = {n: f"rgb/{content.times_s[n]:.6f}.png" for n in content.numbers}
    for file in (folder / "rgb").iterdir():
        file.unlink()
    for number, data in _picture_bytes(content).items():
        (folder / names[number]).write_bytes(data)
    write_list(folder / "rgb.txt", [(content.times_s[n], name) for n, name in names.items()])


def _depths(pattern: str, per_mm: float) -> Put:
    """Depth in units of the file; what is to be shallow with the upper 8 of 16 bits."""

    def put(folder: Path, content: Content) -> None:
        maps = {n: np.rint(depth * per_mm).clip(0, 65535).astype(np.uint16) for n, depth in content.depth_mm.items()}
        maps = {n: (m >> 8).astype(np.uint8) if n in content.shallow else m for n, m in maps.items()}
        data = {n: cv2.imencode(Path(pattern).suffix, m)[1].tobytes() for n, m in maps.items()}
        _files(pattern, folder, {n: content.depth_damage.get(n, bytes)(d) for n, d in data.items()})

    return put


def _listed_depths(folder: Path, content: Content) -> None:
    stamps = {n: content.times_s[n] + 0.005 for n in content.depth_mm if n in content.times_s}
    _depths("depth/{}.png", 5)(folder, content)
    for number, stamp_s in stamps.items():
        (folder / f"depth/{number}.png").rename(folder / f"depth/{stamp_s:.6f}.png")
    write_list(folder / "depth.txt", [(stamp_s, f"depth/{stamp_s:.6f}.png") for stamp_s in stamps.values()])


KINDS: dict[str, Kind] = {
    "c3vd": Kind(
        (
            _pictures("{}_color.png"),
            _depths("{}_depth.tiff", 655.35),
            _table("pose.txt", lambda n, c: c.poses[n].T.ravel().tolist(), ","),
        ),
        depth_unit_mm=100 / 65535,
    ),
    "tum": Kind(
        (
            _listed_pictures,
            _listed_depths,
            _table("groundtruth.txt", lambda n, c: [c.times_s[n] - 0.004, *_in_metres(c.poses[n])]),
        ),
        scale=7,
        depth_unit_mm=0.2,
        stamps=True,
        listed=True,
    ),
    "stereomis": Kind(
        (
            _stacked_movie("endoscope_part0001.mp4"),
            _table("groundtruth.txt", lambda n, c: [n, *_in_metres(c.poses[n])]),
        ),
        pictures="video",
    ),
}
"""Named as `WRITERS`."""


def put(kind: Kind, folder: Path, content: Content) -> None:
    """Put all of `content` over the copy that a writer returned."""
    for one in kind.puts:
        one(folder, content)
    if content.own is not None:
        write_calibration(content.own[0], folder / "camera.yaml", content.own[1])
