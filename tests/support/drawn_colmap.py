"""COLMAP models, text and binary, and the images that they were made of."""

from __future__ import annotations

import struct
from pathlib import Path

from tests.support.drawn_inputs import picture, save

SIZE = (80, 64)
NUMBERS = [2, 9, 10, 12]
UNPOSED = 9
NAMES = {number: f"frame_{number}.png" for number in NUMBERS if number != UNPOSED}
HALF = 0.5**0.5
CAMERA = ("PINHOLE", *SIZE, (61.0, 62.0, 41.0, 30.0))
MODEL_NUMBERS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "DIVISION": 13, "SIMPLE_FISHEYE": 14, "FISHEYE": 15,
    "EUCM": 16, "EQUIRECTANGULAR": 17,
}  # fmt: skip

Pose = tuple[float, ...]
Image = tuple[str, int, Pose]  # name, camera, qw qx qy qz tx ty tz
Camera = tuple[str, int, int, tuple[float, ...]]


def stored_pose(number: int) -> Pose:
    """World-to-camera: a quarter turn about y, which takes z to x and x to -z, then a shift of number, 2, 3."""
    return (HALF, 0.0, HALF, 0.0, float(number), 2.0, 3.0)


def images(names: dict[int, str] | None = None, camera: int = 1) -> list[Image]:
    """The images of a model, not in the order of their numbers, as COLMAP writes them."""
    pairs = (names or NAMES).items()
    return [(name, camera, stored_pose(number)) for number, name in sorted(pairs, key=lambda pair: -pair[0])]


def text_images(registered: list[Image], points: tuple[str, ...] = ("", "1.5 2.5 -1 3.5 4.5 7")) -> str:
    lines = ["# Image list with two lines of data per image:", "# Number of images: 3, mean observations per image: 1"]
    for k, (name, camera, pose) in enumerate(registered):
        lines += [f"{k + 5} {' '.join(map(str, pose))} {camera} {name}", points[k % len(points)]]
    return "\n".join(lines) + "\n"


def binary_images(registered: list[Image]) -> bytes:
    content = struct.pack("<Q", len(registered))
    for k, (name, camera, pose) in enumerate(registered):
        content += struct.pack("<I7dI", k + 5, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", k)
        content += b"".join(struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) for _ in range(k))
    return content


def binary_cameras(cameras: dict[int, Camera]) -> bytes:
    content = struct.pack("<Q", len(cameras))
    for number, (model, width, height, parameters) in cameras.items():
        content += struct.pack("<IiQQ", number, MODEL_NUMBERS[model], width, height)
        content += struct.pack(f"<{len(parameters)}d", *parameters)
    return content


def write_model(folder: Path, registered: list[Image], cameras: dict[int, Camera], form: str = "txt") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if form == "txt":
        lines = [
            "# Camera list",
            "",
            *(f"{n} {m} {w} {h} {' '.join(map(str, p))}" for n, (m, w, h, p) in cameras.items()),
        ]
        (folder / "images.txt").write_text(text_images(registered))
        (folder / "cameras.txt").write_text("\n".join(lines))
    else:
        (folder / "images.bin").write_bytes(binary_images(registered))
        (folder / "cameras.bin").write_bytes(binary_cameras(cameras))
    return folder


def write_numbered(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in NUMBERS:
        save(folder / f"frame_{number}.png", picture(number, SIZE))
    return folder


def write_colmap(root: Path, form: str = "txt", model: str = "sparse/0", camera: Camera = CAMERA) -> Path:
    write_numbered(root / "images")
    write_model(root / model, images(), {1: camera}, form)
    return root
