"""ROS recordings: `FILE.bag` (ROS 1), a folder with `metadata.yaml` and `.db3` or `.mcap` files (ROS 2), `FILE.mcap`.

Images are those of one topic, `sensor_msgs/Image` or `CompressedImage`; the camera is that of its `camera_info`. Depth
is used where its topic's name says that it is aligned to the colour images. Poses are not: which of a recording's
frames is the camera's, no message says.
"""

from __future__ import annotations

import re
import threading
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cached_property
from itertools import islice
from pathlib import Path
from posixpath import commonpath
from typing import Any

import numpy as np

from scopemap.errors import CalibrationError, InputError
from scopemap.frame import TruthQuality
from scopemap.io.datasets.rosbag_camera import calibration_of
from scopemap.io.datasets.rosbag_files import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    Message,
    Recording,
    Topic,
    is_installed,
    is_recording,
)
from scopemap.io.datasets.rosbag_pictures import bare, bits_of, depth_of, eight_bit, encoding_of, is_depth, picture_of
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth

_RECTIFIED = re.compile(r"rect(ified)?(?![a-z])")
_ALIGNED = re.compile(r"(?<!un)(?<!not_)(aligned|registered)")
_ALIGNED_TO = re.compile(r"aligned_depth_to_([a-z0-9]+)")
_MONO = ("mono8", "mono16", "8UC1")
_LEFT, _RIGHT = (re.compile(rf"(?<![a-z]){side}(?![a-z])") for side in ("left", "right"))
_LARGEST_GAP_S = 0.02
_NS_PER_S = 1e9


class RosBag(SourceDefaults):
    """The images of one topic of a recording.

    path : the bag. topic : the topic of the images; None: one with a `camera_info`, in colour, of the left camera and
    with the most messages, in this order. A frame's index is its number among the topic's messages, its time the stamp
    in its header, or when it was recorded where the first message has no stamp.

    Raises `InputError` for what cannot be read, holds no images, or needs the package `rosbags`.
    """

    name = "rosbag"
    stamped = True
    quality: TruthQuality = "registered"

    def __init__(self, path: Path, topic: str | None = None) -> None:
        self.path = path
        self.notes: list[str] = []
        self._recording = Recording(path)
        self.warnings = self._recording.warnings
        self._lock = threading.Lock()
        self._held = ExitStack()
        self._depth_readers: list[Any] = []
        self._grey: set[str] = set()
        self._bits = 0
        with self._recording.opened() as readers:
            pictures, depths = self._image_topics(readers)
            self._topic = self._chosen(pictures, topic)
            first = next(self._recording.messages(readers, [self._topic.name]), None)
            self._stamped = first is not None and first.header_ns != 0
            self.height, self.width = self._size(readers)
            self._take_camera(readers)
        self.count = self._recording.believed(self._topic.total)
        self._depth_topic = self._aligned(depths)
        clock = "stamps in the headers" if self._stamped else "when they were recorded, as headers hold no stamp"
        self.notes += [
            f"time stamps: {clock}",
            "poses in a bag (odometry, tf) are not used: whose they are is not said",
        ]

    is_installed = staticmethod(is_installed)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a ROS bag or MCAP file, or a folder of such files and no images."""
        return is_recording(path)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; an unreadable one is left out with a warning, another size is an `InputError`."""
        last_s = -np.inf
        with self._recording.opened() as readers:
            for number, message in islice(
                enumerate(self._messages(readers, [self._topic.name])), *self._bounds(selection)
            ):
                try:
                    rgb = self._picture(message)
                except InputError as error:
                    self._warn(f"image {number} of {self._topic.name} was left out: {error}")
                    continue
                height, width = rgb.shape[:2]
                if (width, height) != (self.width, self.height):
                    raise InputError(
                        f"reading {self.path}: image {number} of {self._topic.name} is {width}x{height} px, those "
                        f"before it are {self.width}x{self.height} px; a sequence needs frames of one size"
                    )
                time_s = self._time_s(message)
                if time_s <= last_s:
                    self._warn(f"the stamps of {self._topic.name} do not increase: images stay as they were recorded")
                last_s = time_s
                yield SourceFrame(number, time_s, rgb, f"{self._topic.name}[{number}]")

    def stamps(self, selection: slice) -> list[tuple[int, float]]:
        """Return number and time of the selected frames, of images that turn out unreadable, too; decodes none."""
        return list(enumerate(time_s for time_s, _ in self._clock[self._topic.name]))[selection]

    def pose(self, index: int) -> np.ndarray | None:
        """A bag's poses are not used."""
        return None

    def truth(self, index: int) -> SourceTruth | None:
        """Return the aligned depth nearest in time, at most 0.02 s away; None where there is none."""
        times = self._clock[self._topic.name]
        if self._depth_topic is None or not 0 <= index < len(times):
            return None
        depths = self._clock[self._depth_topic.name]
        after = bisect_left(depths, (times[index][0],))
        around = depths[max(after - 1, 0) : after + 1]
        near = min(around, key=lambda depth: abs(depth[0] - times[index][0]), default=None)
        if near is None or abs(near[0] - times[index][0]) > _LARGEST_GAP_S:
            return None
        return SourceTruth(None, self._depth_mm(self._depth_topic, near), self.quality)

    def _depth_mm(self, topic: Topic, stamp: tuple[float, int]) -> np.ndarray:
        time_s, bag_ns = stamp
        # Frames are read ahead in a thread of their own; a bag that is open for depth is one.
        with self._lock:
            if not self._depth_readers:
                self._depth_readers = self._held.enter_context(self._recording.opened())
            found = self._recording.messages(self._depth_readers, [topic.name], bag_ns, bag_ns + 1)
            message = next((message for message in found if self._time_s(message) == time_s), None)
        if message is None:
            raise InputError(f"reading {self.path}: depth at {time_s:.3f} s in {topic.name} is not found again")
        try:
            return depth_of(self._recording.unpacked(message))
        except InputError as error:
            raise InputError(f"reading {self.path}: depth at {time_s:.3f} s in {topic.name}: {error}") from None

    @cached_property
    def _clock(self) -> dict[str, list[tuple[float, int]]]:
        """Time, s, and moment of recording, ns, of all messages, by topic; depth sorted. No image is decoded."""
        names = [self._topic.name, *([self._depth_topic.name] if self._depth_topic else [])]
        clock: dict[str, list[tuple[float, int]]] = {name: [] for name in names}
        with self._recording.opened() as readers:
            for message in self._messages(readers, names):
                clock[message.topic].append((self._time_s(message), message.bag_ns))
        for name in names[1:]:
            clock[name].sort()
        return clock

    def _time_s(self, message: Message) -> float:
        stamp_ns = message.header_ns if self._stamped else 0
        if self._stamped and not stamp_ns:
            self._warn(f"some messages of {message.topic} hold no stamp: the time of recording is used for them")
        return (stamp_ns or message.bag_ns) / _NS_PER_S

    def _messages(self, readers: list[Any], topics: list[str]) -> Iterator[Message]:
        """Yield messages as far as the bag goes; a warning says where it breaks off."""
        read = 0
        try:
            for message in self._recording.messages(readers, topics):
                yield message
                read += 1
        except InputError as error:
            self._warn(f"after {read} messages the bag breaks off, those were used: {error}")

    def _picture(self, message: Message) -> np.ndarray:
        """Return the picture (h, w, 3) uint8; the first of 16 bits decides for all of them how many of these count."""
        rgb = picture_of(self._recording.unpacked(message))
        if rgb.dtype == np.uint8:
            return rgb
        if not self._bits:
            self._bits = bits_of(rgb)
            self.notes.append(f"samples of 16 bits: {self._bits} of them count, by the brightest of the first image")
        if bits_of(rgb) > self._bits:
            self._warn(f"images of {self._topic.name} are brighter than the {self._bits} bits of the first: cut off")
        return eight_bit(rgb, self._bits)

    def _size(self, readers: list[Any]) -> tuple[int, int]:
        """Return height and width of the first image that can be decoded."""
        fault = f"{self._topic.name} holds no message"
        for message in self._messages(readers, [self._topic.name]):
            try:
                height, width = self._picture(message).shape[:2]
            except InputError as error:
                fault = str(error)
                continue
            return height, width
        raise InputError(f"reading {self.path}: no image of {self._topic.name} can be read ({fault})")

    def _image_topics(self, readers: list[Any]) -> tuple[list[Topic], list[Topic]]:
        """Return the topics of pictures and those of depth, by their first messages."""
        pictures: list[Topic] = []
        depths: list[Topic] = []
        for topic in self._recording.topics.values():
            if topic.kind not in (IMAGE, COMPRESSED):
                continue
            try:
                message = next(self._recording.messages(readers, [topic.name]), None)
                encoding = None if message is None else encoding_of(self._recording.unpacked(message))
            except InputError as error:
                self._warn(f"{topic.name} cannot be read: {error}")
                continue
            if encoding is not None:
                if bare(encoding) in _MONO:
                    self._grey.add(topic.name)
                (depths if is_depth(encoding) else pictures).append(topic)
        return pictures, depths

    def _chosen(self, pictures: list[Topic], name: str | None) -> Topic:
        names = ", ".join(topic.name for topic in pictures)
        if name is not None:
            for topic in pictures:
                if topic.name.strip("/") == name.strip("/"):
                    return topic
            raise InputError(f"reading {self.path}: no images under the topic '{name}'; there are {names or 'none'}")
        if not pictures:
            topics = ", ".join(self._recording.topics) or "none"
            foreign = ", ".join(self._recording.foreign)
            fault = f"; of its messages, those serialised as {foreign} are not read, only cdr is" if foreign else ""
            fault += "".join(f"; {warning}" for warning in self.warnings[:1])
            raise InputError(
                f"reading {self.path}: it holds no pictures (looked for sensor_msgs/Image and CompressedImage; topics "
                f"of these kinds and camera_info are {topics}){fault}"
            )
        chosen = max(pictures, key=self._preference)
        others = [topic.name for topic in pictures if topic is not chosen]
        if others:
            self.notes.append(
                f"images of {chosen.name}; also there: {', '.join(others)} (--dataset {self.name}:TOPIC takes another)"
            )
        return chosen

    def _preference(self, topic: Topic) -> tuple[bool, bool, bool, bool, int, bool]:
        left, right = (bool(side.search(topic.name)) for side in (_LEFT, _RIGHT))
        colour = topic.name not in self._grey
        return self._own_info(topic) is not None, colour, left, not right, topic.total, topic.kind == IMAGE

    def _own_info(self, topic: Topic) -> str | None:
        """Return the `camera_info` beside an image topic, where `image_transport` has it."""
        parts = topic.name.split("/")
        # A transport, as in /camera/image_raw/compressed, is one step more.
        places = ["/".join([*parts[:depth], "camera_info"]) for depth in (-1, -2) if len(parts) >= -depth]
        kinds = {place: self._recording.topics.get(place) for place in places}
        return next((place for place, found in kinds.items() if found and found.kind == CAMERA_INFO), None)

    def _take_camera(self, readers: list[Any]) -> None:
        infos = [topic.name for topic in self._recording.topics.values() if topic.kind == CAMERA_INFO]
        name = self._own_info(self._topic) or (infos[0] if len(infos) == 1 else None)
        if name is None:
            if infos:
                self.notes.append(f"no camera_info beside {self._topic.name}; not used: {', '.join(infos)}")
            return
        if name != self._own_info(self._topic):
            self.notes.append(f"the only camera_info, {name}, is taken as that of {self._topic.name}")
        rectified = bool(_RECTIFIED.search(self._topic.name.removesuffix("/compressed").rsplit("/", 1)[-1]))
        try:
            for message in islice(self._recording.messages(readers, [name]), 1):
                info = self._recording.unpacked(message)
                self.calibration = calibration_of(info, (self.width, self.height), rectified, name, self.path.name)
        except (CalibrationError, InputError) as fault:
            self.camera_fault = fault
            return
        if self.calibration is None:
            self.notes.append(f"{name} says that the camera is not calibrated (K is zero)")
        else:
            self.camera, self.camera_source = self.calibration.camera, self.calibration.source

    def _aligned(self, depths: list[Topic]) -> Topic | None:
        """Return the depth that is aligned to the pictures, by its topic's name."""
        aligned = [topic for topic in depths if _ALIGNED.search(topic.name) and self._is_meant(topic)]
        # Of several cameras' depth, that of the same camera has the most of its name in common.
        near = {topic.name: len(commonpath([f"/{topic.name}", f"/{self._topic.name}"])) for topic in aligned}
        chosen = max(aligned, key=lambda topic: (near[topic.name], topic.total), default=None)
        others = [topic.name for topic in depths if topic is not chosen]
        if chosen is not None:
            self.notes.append(f"depth: {chosen.name}, taken as aligned to {self._topic.name}; whole numbers mm, else m")
        if others:
            self.notes.append(f"depth that no name says to be aligned is not used: {', '.join(others)}")
        return chosen

    def _is_meant(self, depth: Topic) -> bool:
        """Whether depth that names the pictures it is aligned to names these."""
        named = _ALIGNED_TO.search(depth.name)
        return named is None or named[1] in self._topic.name

    def _bounds(self, selection: slice) -> tuple[int | None, int | None, int | None]:
        """Return bounds that count from the start; the bag's own count serves only those from the end."""
        if all(bound is None or bound >= 0 for bound in (selection.start, selection.stop)):
            return selection.start, selection.stop, selection.step
        if self.count is None:
            raise InputError(f"reading {self.path}: its length is unknown, so count frames from the start")
        return selection.indices(self.count)

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)
