"""Pictures and depth of a `Content` as the layouts store them: each puts all of it in the place of a copy's own."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import tifffile
from drawn_image_sets import write_depth_exr, write_list
from drawn_scared import write_tar
from drawn_scene import RATE_HZ, Content

Put = Callable[[Path, Content], None]


# ---- pictures


def _files(pattern: str, folder: Path, contents: dict[int, bytes]) -> None:
    for file in folder.glob(re.sub(r"\{.*?\}", "*", pattern)):
        file.unlink()
    for number, data in contents.items():
        (folder / pattern.format(number)).write_bytes(data)


def _encoded(suffix: str, rgb: np.ndarray) -> bytes:
    return cv2.imencode(suffix, np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes()


def _picture_bytes(suffix: str, content: Content) -> dict[int, bytes]:
    plain = {number: _encoded(suffix, rgb) for number, rgb in content.rgb.items()}
    return {number: content.rgb_damage.get(number, bytes)(data) for number, data in plain.items()}


def _again(name: str) -> str:
    """Another name with the same last number."""
    return re.sub(r"(\d+)(?!.*\d)", r"0\1", name)


def damaged_stream(file: Path, content: Content) -> None:
    if content.stream_damage is not None:
        file.write_bytes(content.stream_damage(file.read_bytes()))


def pictures(pattern: str) -> Put:
    def put(folder: Path, content: Content) -> None:
        _files(pattern, folder, _picture_bytes(Path(pattern).suffix, content))
        for number in content.names_again:
            file = folder / pattern.format(number)
            file.with_name(_again(file.name)).write_bytes(file.read_bytes())

    return put


def movie(file: str, stacked: bool = False) -> Put:
    """Pictures as the video `file` of a folder, which only counts them, or "": a video by itself, with time stamps.

    stacked : above those of another view.
    """

    def put(folder: Path, content: Content) -> None:
        target = folder if folder.is_file() else folder / file
        images = [np.vstack([rgb, rgb[::-1]]) if stacked else rgb for _, rgb in sorted(content.rgb.items())]
        with av.open(str(target), "w") as container:
            stream = container.add_stream("mpeg4", rate=RATE_HZ)
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt, stream.gop_size, stream.bit_rate = "yuv420p", 1, 4_000_000
            for place, (number, image) in enumerate(zip(content.numbers, images, strict=True)):
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts = place if file else round(content.times_s[number] * RATE_HZ)
                frame.time_base = Fraction(1, RATE_HZ)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        damaged_stream(target, content)

    return put


def archived_pictures(folder: Path, content: Content) -> None:
    stored = {f"frame{number:06d}.png": data for number, data in _picture_bytes(".png", content).items()}
    again = {_again(name := f"frame{number:06d}.png"): stored[name] for number in content.names_again}
    write_tar(folder / "data" / "rgb_frames.tar.gz", stored | again)
    damaged_stream(folder / "data" / "rgb_frames.tar.gz", content)
    log = {"key": "1_1", "included_frames": content.numbers}
    (folder / "frame_log.json").write_text(json.dumps(log))


def listed_pictures(folder: Path, content: Content) -> None:
    names = {n: f"rgb/{content.times_s[n]:.6f}.png" for n in content.numbers}
    for file in (folder / "rgb").iterdir():
        file.unlink()
    for number, data in _picture_bytes(".png", content).items():
        (folder / names[number]).write_bytes(data)
    write_list(folder / "rgb.txt", [(content.times_s[n], name) for n, name in names.items()])


# ---- depth


def _levels(content: Content, per_mm: float, dtype: type = np.uint16) -> dict[int, np.ndarray]:
    """Depth maps in units of the file; those that are to be shallow with the upper 8 of 16 bits."""
    maps = {
        n: np.rint(depth * per_mm).clip(0, np.iinfo(dtype).max).astype(dtype) for n, depth in content.depth_mm.items()
    }
    return {n: (m >> 8).astype(np.uint8) if n in content.shallow else m for n, m in maps.items()}


def depths(pattern: str, per_mm: float, dtype: type = np.uint16) -> Put:
    def put(folder: Path, content: Content) -> None:
        suffix = Path(pattern).suffix
        data = {n: cv2.imencode(suffix, m)[1].tobytes() for n, m in _levels(content, per_mm, dtype).items()}
        _files(pattern, folder, {n: content.depth_damage.get(n, bytes)(d) for n, d in data.items()})

    return put


def listed_depths(folder: Path, content: Content) -> None:
    stamps = {n: content.times_s[n] + 0.005 for n in content.depth_mm if n in content.times_s}
    depths("depth/{}.png", 5)(folder, content)
    for number, stamp_s in stamps.items():
        (folder / f"depth/{number}.png").rename(folder / f"depth/{stamp_s:.6f}.png")
    write_list(folder / "depth.txt", [(stamp_s, f"depth/{stamp_s:.6f}.png") for stamp_s in stamps.values()])


def red_depths(folder: Path, content: Content) -> None:
    """Centimetres in the red channel."""
    coloured = {n: np.stack([np.full_like(m, 7)] * 2 + [m] * 2, -1) for n, m in _levels(content, 0.1, np.uint8).items()}
    data = {n: cv2.imencode(".png", image)[1].tobytes() for n, image in coloured.items()}
    damaged = {n: content.depth_damage.get(n, bytes)(d) for n, d in data.items()}
    _files("Pixelwise Depths/aov_image_{:04d}.png", folder, damaged)


def depth_buffers(folder: Path, content: Content) -> None:
    for file in (folder / "depth").iterdir():
        file.unlink()
    for number, depth_mm in content.depth_mm.items():
        v = (100 / np.where(depth_mm > 0, depth_mm, np.nan) - 0.25) / 99.75
        v = np.rint(255 * v) / 255 if number in content.shallow else v
        file = folder / f"depth/aov_image_{number:04d}.exr"
        write_depth_exr(file, v.astype(np.float32))
        file.write_bytes(content.depth_damage.get(number, bytes)(file.read_bytes()))


def scene_points(both: bool) -> Put:
    """X, Y, Z of each pixel; `both`: above those of another view."""

    def put(folder: Path, content: Content) -> None:
        u, v = np.meshgrid(np.arange(content.eye.width), np.arange(content.eye.height))
        rays = content.eye.unproject(np.stack([u, v], -1).astype(float))
        files = {}
        for number, depth_mm in content.depth_mm.items():
            points = (rays * depth_mm[..., None]).astype(np.float32)
            points = points.astype(np.uint8) if number in content.shallow else points
            file = folder / "points.tiff"
            tifffile.imwrite(file, np.vstack([points, points]) if both else points, photometric="rgb")
            damage = content.depth_damage.get(number, bytes)
            files[f"scene_points{number:06d}.tiff"] = damage(file.read_bytes())
            file.unlink()
        write_tar(folder / "data" / "scene_points.tar.gz", files)

    return put
