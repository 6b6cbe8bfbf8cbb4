"""ROS recordings made of messages: ROS 1 bags, ROS 2 bags, MCAP."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from tests.support.drawn_inputs import picture

SIZE = (64, 48)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 40_000_000
K = (60.0, 0.0, 31.0, 0.0, 61.0, 24.0, 0.0, 0.0, 1.0)
P = (55.0, 0.0, 30.0, 0.0, 0.0, 56.0, 23.0, 0.0, 0.0, 0.0, 1.0, 0.0)
TYPES_OF = cache(get_typestore)
IMAGE, INFO = "/endoscope/left/image_raw", "/endoscope/left/camera_info"


@dataclass
class Bag:
    """Messages as (topic, recorded at, ns, type, fields), to be written as any kind of recording."""

    messages: list[tuple[str, int, str, dict[str, Any]]] = field(default_factory=list)
    ros1: bool = True

    def _header(self, stamp_ns: int) -> Any:
        types = self.types
        time = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
        return types["std_msgs/msg/Header"](*([0] if self.ros1 else []), time, "camera")

    @property
    def types(self) -> Any:
        return self.store.types

    @property
    def store(self) -> Any:
        return TYPES_OF(Stores.ROS1_NOETIC if self.ros1 else Stores.LATEST)

    def add(self, topic: str, bag_ns: int, kind: str, **fields: Any) -> None:
        self.messages.append((topic, bag_ns, f"sensor_msgs/msg/{kind}", fields))

    def image(
        self, topic: str, number: int, values: np.ndarray, encoding: str, stamp_ns: int | None = None, **other: Any
    ) -> None:
        stamp_ns = START_NS + number * STEP_NS if stamp_ns is None else stamp_ns
        rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
        fields = {"height": len(values), "width": values.shape[1], "encoding": encoding, "is_bigendian": 0}
        fields |= {"step": rows.shape[1], "data": rows.ravel()} | other
        self.add(topic, START_NS + number * STEP_NS + 5, "Image", stamp_ns=stamp_ns, **fields)

    def compressed(self, topic: str, number: int, content: bytes, form: str) -> None:
        stamp_ns = START_NS + number * STEP_NS
        data = np.frombuffer(content, np.uint8)
        self.add(topic, stamp_ns + 5, "CompressedImage", stamp_ns=stamp_ns, format=form, data=data)

    def info(self, topic: str = INFO, model: str = "plumb_bob", d: tuple[float, ...] = (), **other: Any) -> None:
        fields = {"height": SIZE[1], "width": SIZE[0], "distortion_model": model, "d": np.array(d, float)}
        fields |= {"k": np.array(K), "r": np.eye(3).ravel(), "p": np.array(P), "binning_x": 0, "binning_y": 0}
        self.add(topic, START_NS + 3, "CameraInfo", stamp_ns=START_NS, **(fields | {"roi": (0, 0, 0, 0)} | other))

    def _serialized(self, kind: str, fields: dict[str, Any]) -> bytes:
        fields = dict(fields)
        header = self._header(fields.pop("stamp_ns"))
        if "roi" in fields:
            fields["roi"] = self.types["sensor_msgs/msg/RegionOfInterest"](*fields["roi"], False)
        if self.ros1:
            fields = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
        message = self.types[kind](header, **fields)
        return bytes((self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, kind))

    def write(self, writer: Any) -> None:
        with writer:
            connections: dict[str, Any] = {}
            for topic, bag_ns, kind, fields in self.messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], bag_ns, self._serialized(kind, fields))

    def write_bag1(self, file: Path, packing: str = "") -> Path:
        self.ros1 = True
        file.parent.mkdir(exist_ok=True)
        writer = Writer1(file)
        if packing:
            writer.set_compression(Writer1.CompressionFormat[packing])
        self.write(writer)
        return file

    def write_ros2(self, folder: Path, plugin: str = "SQLITE3", packing: str = "") -> Path:
        self.ros1 = False
        writer = Writer2(folder, version=9, storage_plugin=StoragePlugin[plugin])
        if packing:
            writer.set_compression(CompressionMode[packing], CompressionFormat.ZSTD)
        self.write(writer)
        return folder


def small_bag(count: int = 4, encoding: str = "rgb8") -> Bag:
    """A few pictures that carry their numbers, and a camera."""
    bag = Bag()
    bag.info(d=(-0.2, 0.05, 1e-3, 0.0, 0.0))
    for number in range(count):
        rgb = picture(number, SIZE)
        bag.image(IMAGE, number, rgb if encoding == "rgb8" else rgb[..., ::-1], encoding)
    return bag


def write_bag1(folder: Path) -> Path:
    return small_bag().write_bag1(folder / "clip.bag", "LZ4")


def write_ros2(folder: Path) -> Path:
    bag = small_bag()
    for number in range(4):
        depth = np.full((SIZE[1], SIZE[0]), 50 + number, np.uint16)
        bag.image("/endoscope/aligned_depth_to_left/image_raw", number, depth, "16UC1")
    return bag.write_ros2(folder)


def write_mcap(folder: Path) -> Path:
    bag = Bag()
    bag.info(model="equidistant", d=(0.01, 0.0, 0.0, 0.0))
    for number in range(4):
        content = cv2.imencode(".png", picture(number, SIZE)[..., ::-1])[1].tobytes()
        bag.compressed(f"{IMAGE}/compressed", number, content, "rgb8; png compressed bgr8")
    bag.write_ros2(folder, "MCAP", "STORAGE")
    return folder / f"{folder.name}.mcap"
