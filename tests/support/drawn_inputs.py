"""Tiny inputs drawn by code: pictures that carry their number, videos, folders in the data sets' layouts."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.sequence import Sequence

SIZE = (135, 108)  # a tenth of C3VD's


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A picture (h, w, 3) that carries its number as its level of red."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([np.full_like(u, 40 + 5 * number), u % 200, v % 200], -1).astype(np.uint8)


def number_in(rgb: np.ndarray) -> int:
    return round((float(rgb[..., 0].mean()) - 40) / 5)


def save(file: Path, rgb: np.ndarray) -> None:
    assert cv2.imwrite(str(file), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def write_video(file: Path, frames: int, options: dict[str, str] | None = None) -> Path:
    with av.open(str(file), "w", options=options or {}) as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = 160, 120, "yuv420p", 1
        stream.bit_rate = 2_000_000
        for i in range(frames):
            packets = stream.encode(av.VideoFrame.from_ndarray(picture(i, (160, 120)), format="rgb24"))
            container.mux(packets)
        container.mux(stream.encode())
    return file


def poses(count: int) -> np.ndarray:
    return np.stack([se3_exp(np.array([0.01 * i, -0.02, 0.03 * i, 10 + i, 20.0, -30.0])) for i in range(count)])


def write_c3vd(folder: Path, count: int = 11, transposed: bool = True, name: str = "{}_color.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        file = folder / name.format(i)
        save(file, picture(i))
        depth = np.full((SIZE[1], SIZE[0]), 32768, np.uint16)
        depth[0], depth[-1] = 0, 65535
        cv2.imwrite(str(folder / (file.stem.removesuffix("_color") + "_depth.tiff")), depth)
    stored = poses(count + 2).transpose(0, 2, 1) if transposed else poses(count + 2)
    separator = "," if transposed else " "
    (folder / "pose.txt").write_text("\n".join(separator.join(f"{x:.9g}" for x in T.ravel()) for T in stored) + "\n")
    return folder


def write_sevenscenes(folder: Path, count: int = 3) -> Path:
    folder.mkdir()
    for i, T_world_camera in enumerate(poses(count)):
        save(folder / f"frame-{i:06d}.color.png", picture(i, (640, 480)))
        depth = np.full((480, 640), 1500, np.uint16)
        depth[:10] = 65535
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), depth)
        T_world_camera[:3, 3] /= 1000
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", T_world_camera)
    return folder


def frames_of(sequence: Sequence) -> list[Frame]:
    return [frame for frame, _ in sequence]
