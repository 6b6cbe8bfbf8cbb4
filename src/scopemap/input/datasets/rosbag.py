"""ROS recordings: `FILE.bag`, `FILE.mcap`, a folder with `metadata.yaml` and `.db3` or `.mcap` files; extra `ros`.

Images of one topic, its `camera_info`, and depth whose topic's name says that it is aligned. Poses are not used.
"""

from __future__ import annotations

import re
import threading
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from functools import cached_property
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from posixpath import commonpath
from typing import Any, NamedTuple

import numpy as np

from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.input.datasets.rosbag_messages import (
    bit_depth,
    calibration_of,
    depth_of,
    eight_bit,
    encoding_of,
    image_of,
    is_depth,
    is_grey,
)
from scopemap.input.decoding import first_bytes
from scopemap.input.image_names import numeric_order
from scopemap.input.images import image_files
from scopemap.input.source import Source, SourceFrame

_IMAGE = "sensor_msgs/msg/Image"
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_MAGIC = {".bag": b"#ROSBAG V", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_METADATA = "metadata.yaml"
_RECTIFIED = re.compile(r"rect(ified)?(?![a-z])")
_ALIGNED = re.compile(r"(?<!un)(?<!not_)(aligned|registered)(?:_depth_to_([a-z0-9]+))?")
_LEFT = re.compile(r"(?<![a-z])left(?![a-z])")
_RIGHT = re.compile(r"(?<![a-z])right(?![a-z])")
_LARGEST_GAP_S = 0.02
_NS_PER_S = 10**9


class _Message(NamedTuple):
    """One message: its topic, when it was recorded, the stamp in its header or 0, and its fields, None if damaged."""

    topic: str
    bag_ns: int
    header_ns: int
    fields: Any

    @property
    def content(self) -> Any:
        """The fields as attributes; `InputError` where the message is damaged."""
        if self.fields is None:
            raise InputError("the message is damaged")
        return self.fields


class _Topic(NamedTuple):
    """A topic: its name, the type and number of its messages, the encoding of images or "", and its first message."""

    name: str
    kind: str
    total: int
    encoding: str
    first: _Message


class RosBag(Source):
    """The images of one topic of a recording.

    path : the bag. topic : the topic of the images; None: one with a `camera_info`, in colour, of the left camera and
    with the most messages, in this order. A frame's index is its number among the topic's messages, its time the stamp
    in its header, or the time of recording where the first message has no stamp.

    Raises `InputError` for what cannot be read, holds no images, or needs the package `rosbags`.
    """

    name = "rosbag"
    stamped = True

    def __init__(self, path: Path, topic: str | None = None) -> None:
        if find_spec("rosbags") is None:
            raise InputError(f"reading {path}: it is a ROS bag; install its reader: pip install -e '.[ros]'")
        super().__init__(path)
        self._storage, self._bits = _storage_of(path), 0
        self._lock, self._open_readers = threading.Lock(), ExitStack()
        self._depth_reader: Any = None
        with self._opened() as reader:
            self._topics = self._topics_in(reader)
            self._topic = self._chosen(topic)
            self._stamped = self._topic.first.header_ns != 0
            self.height, self.width = self._size(reader)
        self._take_camera()
        # A count that the files have no room for is the claim of a damaged bag.
        files = self._storage.iterdir() if self._storage.is_dir() else [self._storage]
        self.count = min(self._topic.total, sum(file.stat().st_size for file in files if file.is_file()))
        self._depth_topic = self._aligned()
        clock = "stamps in the headers" if self._stamped else "when they were recorded, as headers hold no stamp"
        self.notes += [f"time stamps: {clock}", "poses in a bag (odometry, tf) are not used"]

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a bag by ending and first bytes, or a folder with a bag's files and no images."""
        if not path.is_dir():
            magic = _MAGIC.get(path.suffix)
            return magic is not None and first_bytes(path, len(magic)) == magic
        files = _storages_in(path)
        is_bag = bool(files) and ((path / _METADATA).is_file() or any(RosBag.recognises(file) for file in files))
        return is_bag and not image_files(path)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; unreadable ones, with a warning, and those of another size are left out."""
        last_s = -np.inf
        with self._opened() as reader:
            messages = enumerate(self._as_far_as_read(reader, [self._topic.name]))
            for number, message in islice(messages, *selection.indices(self.count or 0)):
                try:
                    rgb = self._picture(message)
                except InputError as error:
                    self._warn(f"image {number} of {self._topic.name} was left out: {error}")
                    continue
                time_s = self._time_of(message)
                if time_s <= last_s:
                    self._warn(f"the stamps of {self._topic.name} do not increase: images keep the order of recording")
                last_s = time_s
                frame = self._of_one_size(SourceFrame(number, time_s, rgb, f"{self._topic.name}[{number}]"))
                if frame is not None:
                    yield frame

    def stamps(self, selection: slice) -> list[tuple[int, float]]:
        """Return number and time of the selected frames, also of unreadable images; decodes none."""
        return list(enumerate(time_s for time_s, _ in self._clock[self._topic.name]))[selection]

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """Return the aligned depth nearest in time, at most 0.02 s away; None where there is none."""
        times = self._clock[self._topic.name]
        if self._depth_topic is None or not 0 <= index < len(times):
            return None
        topic, time_s = self._depth_topic.name, times[index][0]
        after = bisect_left(self._clock[topic], (time_s,))
        around = self._clock[topic][max(after - 1, 0) : after + 1]
        nearest_s, bag_ns = min(around, key=lambda depth: abs(depth[0] - time_s), default=(np.inf, 0))
        if abs(nearest_s - time_s) > _LARGEST_GAP_S:
            return None
        # Frames are read ahead in a thread of their own; one reader of depth stays open for all others.
        with self._lock:
            self._depth_reader = self._depth_reader or self._open_readers.enter_context(self._opened())
            message = next(self._messages(self._depth_reader, [topic], bag_ns, bag_ns + 1), None)
        if message is None:
            raise InputError(f"reading {self.path}: depth recorded at {bag_ns} ns in {topic} is not found again")
        try:
            return depth_of(message.content)
        except InputError as error:
            raise InputError(f"reading {self.path}: depth recorded at {bag_ns} ns in {topic}: {error}") from None

    @cached_property
    def _clock(self) -> dict[str, list[tuple[float, int]]]:
        """Time, s, and time of recording, ns, of all messages, by topic; depth sorted. No image is decoded."""
        clock: dict[str, list[tuple[float, int]]] = {t.name: [] for t in (self._topic, self._depth_topic) if t}
        with self._opened() as reader:
            for message in self._as_far_as_read(reader, list(clock)):
                clock[message.topic].append((self._time_of(message), message.bag_ns))
        if self._depth_topic:
            clock[self._depth_topic.name].sort()
        return clock

    def _time_of(self, message: _Message) -> float:
        stamp_ns = message.header_ns if self._stamped else 0
        if self._stamped and not stamp_ns:
            self._warn(f"some messages of {message.topic} hold no time stamp: their time of recording is used")
        return (stamp_ns or message.bag_ns) / _NS_PER_S

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Open the bag with the reader of `rosbags` for its version."""
        from rosbags import rosbag1, rosbag2

        with self._reporting():
            reader = (rosbag1 if self._storage.suffix == ".bag" else rosbag2).Reader(self._storage)
            reader.open()
        with closing(reader):
            yield reader

    def _messages(
        self, reader: Any, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[_Message]:
        """Yield the messages of `topics` recorded in [start_ns, stop_ns); `InputError` where the bag breaks off."""
        from rosbags.typesys import Stores, get_typestore

        connections = [connection for connection in _readable(reader) if connection.topic in topics]
        found = reader.messages(connections, start_ns, stop_ns) if connections else iter(())
        is_ros1 = self._storage.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
        deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        while True:
            with self._reporting():
                connection, bag_ns, raw = next(found, (None, 0, b""))
            if connection is None:
                return
            fields: Any = None
            header_ns = 0
            with suppress(Exception):  # damaged bytes end in exceptions of any kind
                fields = deserialize(raw, connection.msgtype)
                header_ns = fields.header.stamp.sec * _NS_PER_S + fields.header.stamp.nanosec
            yield _Message(connection.topic, bag_ns, header_ns, fields)

    def _as_far_as_read(self, reader: Any, topics: list[str]) -> Iterator[_Message]:
        """Yield messages up to where the bag breaks off; a warning says so."""
        read = 0
        try:
            for message in self._messages(reader, topics):
                yield message
                read += 1
        except InputError as error:
            self._warn(f"after {read} messages the bag breaks off; those were used: {error}")

    def _reporting(self) -> AbstractContextManager[None]:
        advice = "'rosbag reindex', 'ros2 bag reindex' or 'mcap recover' may mend it"
        return reporting(f"reading {self.path}: the bag is damaged or was not closed; {advice}")

    def _picture(self, message: _Message) -> np.ndarray:
        """Return the image (h, w, 3) uint8; the first one of 16 bits decides how many bits are used of all."""
        rgb = image_of(message.content)
        if rgb.dtype == np.uint8:
            return rgb
        if not self._bits:
            self._bits = bit_depth(rgb)
            self.notes.append(f"samples of 16 bits: {self._bits} are used, by the brightest of the first image")
        if bit_depth(rgb) > self._bits:
            self._warn(f"images of {self._topic.name} are brighter than the {self._bits} bits of the first: clipped")
        return eight_bit(rgb, self._bits)

    def _size(self, reader: Any) -> tuple[int, int]:
        """Return height and width of the first image that can be decoded."""
        fault = f"{self._topic.name} holds no message"
        for message in self._as_far_as_read(reader, [self._topic.name]):
            try:
                return self._picture(message).shape[:2]
            except InputError as error:
                fault = str(error)
        raise InputError(f"reading {self.path}: no image of {self._topic.name} can be read ({fault})")

    def _topics_in(self, reader: Any) -> dict[str, _Topic]:
        """Return the topics of images and cameras that hold messages; a warning names those that cannot be read."""
        counts: Counter[tuple[str, str]] = Counter()
        with self._reporting():  # counts are read from metadata as they are written
            for connection in _readable(reader):
                counts[connection.topic, connection.msgtype] += int(connection.msgcount)
        topics: dict[str, _Topic] = {}
        for (name, kind), count in counts.items():
            try:
                first = next(self._messages(reader, [name]), None) if count > 0 else None
                if first is not None:
                    encoding = "" if kind == _CAMERA_INFO else encoding_of(first.content)
                    topics[name] = _Topic(name, kind, count, encoding, first)
            except InputError as error:
                self._warn(f"{name} cannot be read: {error}")
        return topics

    def _chosen(self, name: str | None) -> _Topic:
        images = [topic for topic in self._topics.values() if topic.encoding and not is_depth(topic.encoding)]
        names = ", ".join(topic.name for topic in images) or "none"
        if name is not None:
            if found := [topic for topic in images if topic.name.strip("/") == name.strip("/")]:
                return found[0]
            raise InputError(f"reading {self.path}: no images under the topic '{name}'; there are {names}")
        if not images:
            fault = "".join(f"; {warning}" for warning in self.warnings[:1])
            looked = f"topics of these kinds and camera_info are {', '.join(self._topics) or 'none'}"
            looked = f"looked for sensor_msgs/Image and CompressedImage; {looked}"
            raise InputError(f"reading {self.path}: it holds no images ({looked}){fault}")

        def preference(topic: _Topic) -> tuple[bool, bool, bool, bool, int, bool]:
            left, right = (bool(side.search(topic.name)) for side in (_LEFT, _RIGHT))
            colour = not is_grey(topic.encoding)
            return self._own_info(topic) is not None, colour, left, not right, topic.total, topic.kind == _IMAGE

        chosen = max(images, key=preference)
        if len(images) > 1:
            self.notes.append(f"images of {chosen.name}, one of {names} (--dataset {self.name}:TOPIC takes another)")
        return chosen

    def _own_info(self, topic: _Topic) -> str | None:
        """Return the `camera_info` beside an image topic, where `image_transport` has it."""
        parts = topic.name.split("/")
        # A transport, as in /camera/image_raw/compressed, is one level more.
        for above in (parts[:-1], parts[:-2]):
            info = self._topics.get("/".join([*above, "camera_info"]))
            if info is not None and info.kind == _CAMERA_INFO:
                return info.name
        return None

    def _take_camera(self) -> None:
        infos = [topic.name for topic in self._topics.values() if topic.kind == _CAMERA_INFO]
        name = self._own_info(self._topic)
        if name is None and len(infos) == 1:
            name = infos[0]
            self.notes.append(f"the only camera_info, {name}, is taken as that of {self._topic.name}")
        if name is None:
            if infos:
                self.notes.append(f"no camera_info beside {self._topic.name}; not used: {', '.join(infos)}")
            return
        rectified = bool(_RECTIFIED.search(self._topic.name.removesuffix("/compressed").rsplit("/", 1)[-1]))
        try:
            info = self._topics[name].first.content
            self.calibration = calibration_of(info, (self.width, self.height), rectified, name, self.path.name)
        except (CalibrationError, InputError) as fault:
            self.camera_fault = fault
            return
        if self.calibration is None:
            self.notes.append(f"the camera of {name} is not calibrated (K is zero)")
        else:
            self.camera, self.camera_source = self.calibration.camera, self.calibration.source

    def _aligned(self) -> _Topic | None:
        """Return the depth topic that is aligned to the images, by its name."""
        depths = [topic for topic in self._topics.values() if is_depth(topic.encoding)]
        matches = [(topic, _ALIGNED.search(topic.name)) for topic in depths]
        aligned = [topic for topic, match in matches if match and (match[2] or "") in self._topic.name]
        # Of several cameras' depth, that of the same camera has the most of its name in common.
        own = f"/{self._topic.name}"
        chosen = max(aligned, key=lambda t: (len(commonpath([f"/{t.name}", own])), t.total), default=None)
        others = [topic.name for topic in depths if topic is not chosen]
        if chosen is not None:
            self.notes.append(f"depth: {chosen.name}, taken as aligned to {self._topic.name}; whole numbers mm, else m")
        if others:
            self.notes.append(f"depth is not used where no name states that it is aligned: {', '.join(others)}")
        return chosen


def _storages_in(folder: Path) -> list[Path]:
    files = (file for file in folder.iterdir() if file.name.removesuffix(".zstd").endswith(tuple(_MAGIC)))
    return sorted((file for file in files if file.is_file()), key=numeric_order)


def _storage_of(path: Path) -> Path:
    """Return what `rosbags` opens: a file, or a folder with `metadata.yaml`."""
    if not path.is_dir() or (path / _METADATA).is_file():
        return path
    files = _storages_in(path)
    if len(files) != 1:
        some = ", ".join(file.name for file in files[:5])
        raise InputError(f"reading {path}: {len(files)} bags and no {_METADATA} that joins them ({some}); give one")
    return files[0]


def _readable(reader: Any) -> list[Any]:
    """Return the connections of the types that are read; `rosbags` deserializes ROS 1 and CDR."""
    found = [one for one in reader.connections if one.msgtype in (_IMAGE, _COMPRESSED, _CAMERA_INFO)]
    return [one for one in found if getattr(one.ext, "serialization_format", "cdr") == "cdr"]
