"""The frame store: tracked frames (about 5 bytes a pixel) and rows in tables, on disk until the last frame."""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from threading import Lock
from typing import IO, Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.frame import REGIONS, Frame, Rows

# ln of millimetres in 16 bits: 0.0001 mm (standard deviations are small) to 34 m in steps of 0.03 %; 0 = unknown.
_LOG_STEP = 3e-4
_MIN_MM = 1e-4  # see above
_MAX_CODE = 65535  # of 16 bits
_CHECKED_AT_ONCE = 1 << 20  # bytes that are read at once
_MOST_SPREAD = 16  # by hand: frames of a submap at which its surface is rendered again
# Colours only paint the mesh: JPEG takes a fifth of the time and half of the space of a lossless format.
# The quality by hand.
_COLOUR_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


_ENTRY = np.dtype(
    [
        ("index", np.int64),
        ("time_s", np.float64),
        ("camera", np.int64),
        ("has_pose", np.int64),
        ("T_world_camera", np.float64, (4, 4)),
        ("offset", np.int64),
        ("sizes", np.int64, (6,)),
        ("crc", np.uint32),
        ("median_depth_mm", np.float64),
        ("nonrigidity", np.float32, REGIONS),
        ("quality", np.float64),
    ]
)
"""Small data of a frame, the number of its camera, and its images: offset in the file, sizes (0: none), CRC-32."""


class StoredFile:
    """A file of a frame store, created with its first bytes; `size` and `crc` count all that was put in.

    Raises `InputError` where the folder is full or read-only, and where what is read is not what was put in.
    """

    def __init__(self, store: FrameStore, name: str) -> None:
        self.name, self._store = name, store
        self.size = self.crc = 0
        self._file: IO[bytes] | None = None

    def append(self, content: bytes) -> None:
        """Put bytes in behind those that it has."""
        with self._store.storing():
            if self._file is None:
                self._file = self._store.opened(self.name, "w+b")
            self._file.seek(self.size)
            self._file.write(content)
            self._file.flush()
        self.size, self.crc = self.size + len(content), zlib.crc32(content, self.crc)

    def clear(self) -> None:
        """Forget all that was put in, and free the disk."""
        self.size = self.crc = 0
        if self._file is not None:
            self._file.truncate(0)

    def read(self, start: int, size: int) -> bytes:
        """Return `size` bytes from `start` on; where they are all, by their checksum."""
        if self._file is None:
            return b""
        self._file.seek(start)
        found = self._file.read(size)
        self.check(len(found) == size and (size < self.size or zlib.crc32(found) == self.crc))
        return found

    def check(self, is_whole: bool) -> None:
        """Raise `InputError` unless what was read is whole."""
        if not is_whole:
            raise InputError(
                f"the stored frames are damaged ({self.name}): the disk gives back other bytes than it got"
            )

    def sync(self) -> None:
        """Have the disk hold what was put in."""
        if self._file is not None:
            os.fsync(self._file.fileno())

    @property
    def state(self) -> dict[str, Any]:
        """What `reopen` takes, as JSON holds it."""
        return {"name": self.name, "size": self.size, "crc": self.crc}

    def reopen(self, state: Mapping[str, Any]) -> None:
        """Go on with the file as it was in a state; what was put in later is cut off."""
        self.size, self.crc = int(state["size"]), int(state["crc"])
        if self.size:
            self._file = self._store.opened(self.name, "r+b")
            self._file.truncate(self.size)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with suppress(OSError):  # a full disk, which `append` has told
                self._file.close()


def check_stored(folder: Path, files: Iterable[Mapping[str, Any]]) -> None:
    """Raise `InputError` unless a store's folder holds the files of these states of `StoredFile`s.

    What follows after `size` bytes does not count.
    """
    for facts in files:
        crc, left = 0, int(facts["size"])
        file = folder / facts["name"]
        with reporting(f"cannot read the stored frames {file}"):
            if left:
                with file.open("rb") as stream:
                    while left and (part := stream.read(min(left, _CHECKED_AT_ONCE))):
                        crc, left = zlib.crc32(part, crc), left - len(part)
        if left or crc != facts["crc"]:
            raise InputError(f"the stored frames {file} are damaged")


class StoredRows(Rows):
    """Rows in a file of a frame store, which is created with the first; one thread at a time may use them."""

    def __init__(self, kind: np.dtype, file: StoredFile) -> None:
        super().__init__(kind)
        self._file = file

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._file.size // self._kind.itemsize

    def append(self, rows: np.ndarray) -> None:
        """Put rows (n,) of the kind in. Raises `InputError` where the folder is full or read-only."""
        self._file.append(self._raw(rows).tobytes())

    def read(self, first: int = 0, count: int | None = None) -> np.ndarray:
        """Return `count` rows from the row `first` on; None: all. Raises `InputError` where they are damaged."""
        size = (len(self) - first if count is None else count) * self._kind.itemsize
        return np.frombuffer(bytearray(self._file.read(first * self._kind.itemsize, size)), self._kind)

    def keep(self, kept: np.ndarray) -> None:
        """Forget the rows where `kept`, (N,) bool, is False."""
        rows = self.read()[kept]
        self._file.clear()
        self.append(rows)

    def parts(self) -> Iterator[np.ndarray]:
        """Yield all rows in parts. Raises `InputError` after the last one where they are damaged."""
        crc = 0
        for part in super().parts():
            crc = zlib.crc32(part.tobytes(), crc)
            yield part
        self._file.check(crc == self._file.crc or not len(self))


class FrameStore:
    """Stores frames with depth in one file, which is created with the first frame, and tables in files beside it.

    folder : where these are; None: the system's temporary folder. name : of a folder in it for the files, which then
    stay when the store is closed, for a run to resume; "": they are deleted then.
    """

    def __init__(self, folder: Path | None = None, name: str = "") -> None:
        self._folder, self._name = Path(tempfile.gettempdir() if folder is None else folder), name
        self._images = StoredFile(self, "frames")
        self._files, self._lasting = [self._images], [self._images]
        self._entries = self.lasting_table("frame_entries", _ENTRY)
        self._cameras = list[PinholeCamera]()
        self._known: tuple[np.ndarray, dict[int, int]] | None = None
        self._reading = Lock()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._entries)

    def table(self, name: str, kind: np.dtype) -> StoredRows:
        """Return new rows of a kind in a file of that name."""
        self._files.append(StoredFile(self, name))
        return StoredRows(kind, self._files[-1])

    def lasting_table(self, name: str, kind: np.dtype) -> StoredRows:
        """Return new rows as `table` does, which a resumed run has again, as it has the frames."""
        rows = self.table(name, kind)
        self._lasting.append(self._files[-1])
        return rows

    def put(self, frame: Frame) -> None:
        """Store a frame. Raises `InputError` where the folder is full or read-only."""
        assert frame.depth_mm is not None
        masks = frame.highlights, frame.instruments
        parts = [
            cv2.imencode(".jpg", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), _COLOUR_QUALITY)[1].tobytes(),
            np.packbits(frame.valid).tobytes(),
            *(np.packbits(frame.valid & False if some is None else some).tobytes() for some in masks),
            *(_encoded(mm).tobytes() for mm in (frame.depth_mm, frame.depth_sigma_mm) if mm is not None),
        ]
        content, offset = b"".join(parts), self._images.size
        self._images.append(content)
        if frame.camera not in self._cameras:
            self._cameras.append(frame.camera)
        entry = np.zeros(1, _ENTRY)
        entry["index"], entry["time_s"], entry["offset"] = frame.index, frame.time_s, offset
        entry["camera"], entry["median_depth_mm"] = self._cameras.index(frame.camera), median_depth_of(frame)
        entry["sizes"][0, : len(parts)] = [len(part) for part in parts]
        entry["quality"], entry["crc"] = frame.quality, zlib.crc32(content)
        entry["nonrigidity"] = np.nan if frame.nonrigidity is None else frame.nonrigidity
        if frame.T_world_camera is not None:
            entry["has_pose"], entry["T_world_camera"] = True, frame.T_world_camera
        self._entries.append(entry)
        self._known = None

    def clear(self) -> None:
        """Forget the frames; tables stay."""
        self._images.clear()
        self._entries.keep(np.zeros(len(self), bool))
        self._known = None

    @contextmanager
    def storing(self) -> Iterator[None]:
        """Turn an `OSError` of writing into the `InputError` that names the folder."""
        try:
            yield
        except OSError as error:
            raise InputError(
                f"cannot store frames in {self._folder}: {error.strerror or error}; free space there"
            ) from None

    def opened(self, name: str, mode: str) -> IO[bytes]:
        """Open a file of the store."""
        if not self._name:
            return tempfile.TemporaryFile(dir=self._folder, prefix="scopemap")
        (self._folder / self._name).mkdir(exist_ok=True)
        return (self._folder / self._name / name).open(mode)

    def record(self) -> dict[str, Any]:
        """Have the disk hold the frames and the lasting tables, and return what `resume` takes, as JSON holds it.

        Raises `OSError` where the disk cannot.
        """
        for file in self._lasting:
            file.sync()
        return {"files": [file.state for file in self._lasting], "cameras": [asdict(one) for one in self._cameras]}

    def resume(self, record: Mapping[str, Any]) -> None:
        """Take frames and lasting tables as they were when a record was made; what was put in later is cut off.

        They are those of a store in the same folder, which had the same lasting tables. Raises `OSError`.
        """
        for file, state in zip(self._lasting, record["files"], strict=True):
            file.reopen(state)
        self._cameras, self._known = [PinholeCamera(**camera) for camera in record["cameras"]], None

    def __contains__(self, index: int) -> bool:
        """Return whether the frame with this number is stored."""
        return index in self._index()[1]

    def frame(self, index: int) -> Frame:
        """Return the frame with this number; any thread may call it."""
        entries, place = self._index()
        return self._read(entries[place[index]])

    def frames(self, among: Collection[int] | None = None) -> Iterator[Frame]:
        """Yield the frames, or those with the given numbers, in order; depth to 0.015 %, colours to a few levels."""
        for entry in self._index()[0]:
            if among is None or int(entry["index"]) in among:
                yield self._read(entry)

    def median_depth_mm(
        self, among: Collection[int] | None = None, factor: Callable[[int], float] = lambda _: 1.0
    ) -> float | None:
        """Return the median of the frames' median depths, mm, None where no depth is known.

        among : as in `frames`. factor : returns that of a frame's depth by its number.
        """
        entries = [entry for entry in self._index()[0] if among is None or int(entry["index"]) in among]
        medians_mm = [factor(int(entry["index"])) * entry["median_depth_mm"] for entry in entries]
        known_mm = [median_mm for median_mm in medians_mm if np.isfinite(median_mm)]
        return float(np.median(known_mm)) if known_mm else None

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def _index(self) -> tuple[np.ndarray, dict[int, int]]:
        """Return the entries of all frames, and the place of each by its number."""
        with self._reading:
            if self._known is None:
                entries = self._entries.read()
                self._known = entries, {index: place for place, index in enumerate(entries["index"].tolist())}
            return self._known

    def _read(self, entry: np.void) -> Frame:
        camera, sizes = self._cameras[entry["camera"]], entry["sizes"].tolist()
        shape = (camera.height, camera.width)
        with self._reading:
            content = self._images.read(int(entry["offset"]), sum(sizes))
        self._images.check(zlib.crc32(content) == entry["crc"])
        ends = np.cumsum(sizes).tolist()
        parts = [
            np.frombuffer(content, np.uint8, size, end - size) for size, end in zip(sizes, ends, strict=True) if size
        ]
        colours, valid, highlights, instruments, depth, *sigma = parts
        return Frame(
            int(entry["index"]),
            float(entry["time_s"]),
            cv2.cvtColor(np.asarray(cv2.imdecode(colours, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB),
            camera,
            _bits(valid, shape),
            _decoded(depth, shape),
            entry["T_world_camera"] if entry["has_pose"] else None,
            depth_sigma_mm=_decoded(sigma[0], shape) if sigma else None,
            highlights=_bits(highlights, shape),
            instruments=_bits(instruments, shape),
            nonrigidity=entry["nonrigidity"].copy(),
            quality=float(entry["quality"]),
        )


class SpreadFrames:
    """Every n-th of the frames with a pose that are put in, at most `_MOST_SPREAD`; n doubles as they grow more."""

    def __init__(self) -> None:
        self._kept = list[Frame | int]()
        self._every, self._count = 1, 0

    def put(self, frame: Frame, store: FrameStore | None = None) -> None:
        """Keep or skip a frame; store : where it is kept, as those of many maps fill the memory."""
        if frame.T_world_camera is None:
            return
        if self._count % self._every == 0:
            if store is not None and frame.index not in store:
                store.put(frame)
            self._kept.append(frame if store is None else frame.index)
        self._count += 1
        if len(self._kept) > _MOST_SPREAD:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def frames(self, store: FrameStore) -> list[Frame]:
        """Return the frames that are kept, in memory or in the store."""
        return [store.frame(one) if isinstance(one, int) else one for one in self._kept]


def median_depth_of(frame: Frame) -> float:
    """Return the median of the known depth in a frame's usable pixels, mm; NaN where there is none."""
    assert frame.depth_mm is not None
    some_mm = frame.depth_mm[::4, ::4][frame.valid[::4, ::4]]
    some_mm = some_mm[np.isfinite(some_mm)]
    return float(np.median(some_mm)) if some_mm.size else float("nan")


def _encoded(mm: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        code = np.float32(1.5 - np.log(_MIN_MM) / _LOG_STEP) + np.log(mm) * np.float32(1 / _LOG_STEP)
    # Beyond the range is unknown, not at its end.
    return np.where(np.isfinite(code) & (code < _MAX_CODE + 1), np.maximum(code, 1), 0).astype(np.uint16)


def _bits(packed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.unpackbits(packed, count=shape[0] * shape[1]).reshape(shape).astype(bool)


def _decoded(code: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return _millimetres()[code.view(np.uint16).reshape(shape)]


@cache
def _millimetres() -> np.ndarray:
    """Return the depth that each code stands for, (65536,) float32."""
    mm = _MIN_MM * np.exp((np.arange(_MAX_CODE + 1) - 1) * _LOG_STEP)
    mm[0] = np.nan
    return mm.astype(np.float32)
