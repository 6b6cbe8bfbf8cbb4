"""Pictures and depth of a `Content` in the containers: ROS recordings, and DICOM video and multi-frame images."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drawn_bags import IMAGE, INFO, SIZE, START_NS, Bag
from drawn_dicom import jpeg, packed
from drawn_scene import RATE_HZ, Content
from pydicom.uid import MPEG4HP41, JPEGBaseline8Bit
from stored_frames import Put, damaged_stream, movie

_DEPTH = "/endoscope/aligned_depth_to_left/image_raw"


def recording(form: str) -> Put:
    """Return what writes a recording, form : "bag" (ROS 1), "ros2" (with depth, float metres) or "mcap" (packed)."""

    def put(entry: Path, content: Content) -> None:
        bag = Bag()
        bag.info(INFO, **_camera(form, content))
        for place, number in enumerate(content.numbers):
            times = START_NS + round(place * 1e9 / RATE_HZ), START_NS + round(content.times_s[number] * 1e9)
            _add_picture(bag, content, number, times, packed=form == "mcap")
            if form == "ros2" and number in content.depth_mm:
                _add_depth(bag, content, number, times)
        folder = entry if entry.is_dir() else entry.parent
        shutil.rmtree(folder)
        if form == "bag":
            bag.write_bag1(entry, "LZ4")
        else:
            bag.write_ros2(folder, *(("MCAP", "STORAGE") if form == "mcap" else ()))
        damaged_stream(entry if entry.is_file() else next(folder.glob("*.db3")), content)

    return put


def _camera(form: str, content: Content) -> dict[str, Any]:
    """The camera of the copy that the writer made, or the one that was put into its place."""
    if content.own is None or content.own[1] is not None:
        lens = (0.01, 0.0, 0.0, 0.0) if form == "mcap" else (-0.2, 0.05, 1e-3, 0.0, 0.0)
        return {"model": "equidistant" if form == "mcap" else "plumb_bob", "d": lens}
    camera = content.own[0].central
    return {"k": camera.matrix.ravel(), "width": camera.width, "height": camera.height}


def _add_picture(bag: Bag, content: Content, number: int, times: tuple[int, int], packed: bool) -> None:
    bag_ns, stamp_ns = times
    rgb, damage = np.ascontiguousarray(content.rgb[number]), content.rgb_damage.get(number, bytes)
    if packed:
        data = damage(cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        fields: dict[str, Any] = {"format": "rgb8; png compressed bgr8"}
        bag.add(f"{IMAGE}/compressed", bag_ns, "CompressedImage", stamp_ns=stamp_ns, data=_array(data), **fields)
        return
    fields = {"height": rgb.shape[0], "width": rgb.shape[1], "encoding": "rgb8", "is_bigendian": 0}
    fields |= {"step": 3 * rgb.shape[1], "data": _array(damage(rgb.tobytes()))}
    bag.add(IMAGE, bag_ns, "Image", stamp_ns=stamp_ns, **fields)


def _add_depth(bag: Bag, content: Content, number: int, times: tuple[int, int]) -> None:
    depth_m = content.depth_mm[number] / 1000
    if content.own is not None and content.own[1] is not None:
        depth_m = depth_m * content.own[1] / content.depth_unit_mm
    if number in content.shallow:
        depth_m = np.rint(depth_m / depth_m.max() * 255) / 255 * depth_m.max()
    data = content.depth_damage.get(number, bytes)(depth_m.astype(np.float32).tobytes())
    fields = {"height": SIZE[1], "width": SIZE[0], "encoding": "32FC1", "is_bigendian": 0, "step": 4 * SIZE[0]}
    bag.add(_DEPTH, times[0], "Image", stamp_ns=times[1], data=_array(data), **fields)


def _array(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def dicom_frames(entry: Path, content: Content) -> None:
    """Pictures of a multi-frame image, each packed by itself, with the time from one to the next."""
    frames = [content.rgb_damage.get(number, bytes)(jpeg(content.rgb[number])) for number in content.numbers]
    frames = [frame or b"\0\0" for frame in frames]  # the library packs nothing that is empty
    steps_ms = np.rint(1000 * np.diff([content.times_s[number] for number in content.numbers], prepend=0.0))
    tags = {"PhotometricInterpretation": "YBR_FULL_422", "FrameTimeVector": steps_ms.tolist()}
    packed(entry, frames, JPEGBaseline8Bit, **tags)
    damaged_stream(entry, content)


def dicom_video(entry: Path, content: Content) -> None:
    """A video with time stamps of its own, and nothing beside it that states others."""
    plain = entry.with_name("plain.mp4")
    plain.touch()
    movie("")(plain, replace(content, stream_damage=None))
    height, width = content.rgb[content.numbers[0]].shape[:2]
    tags = {"PhotometricInterpretation": "YBR_PARTIAL_420", "Rows": height, "Columns": width}
    packed(entry, [plain.read_bytes()], MPEG4HP41, NumberOfFrames=len(content.numbers), **tags)
    plain.unlink()
    damaged_stream(entry, content)
