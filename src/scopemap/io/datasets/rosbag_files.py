"""ROS recordings: ROS 1 bags, ROS 2 bags (SQLite, MCAP) and their messages, through the package `rosbags` (an extra).

Message definitions inside a bag are not used, as `rosbags` would make them into code: the few types that are read here
are those of the ROS distributions. What unpacks is bounded, since a few bytes can claim to be gigabytes.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple
from urllib.parse import quote

from scopemap.errors import InputError, ScopemapError
from scopemap.io.datasets.rosbag_mcap import MAGIC, check_profile
from scopemap.io.datasets.rosbag_unpacking import bound_unpacking, unpacked_zstd, zstandard
from scopemap.io.images import image_files, numeric_order

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_ROS1, _SQLITE, _ZSTD = b"#ROSBAG V", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_METADATA, _CDR, _LONGEST_WORD = "metadata.yaml", "cdr", 40
_TABLES, _SCHEMA_BYTES = {b"topics", b"messages"}, 1 << 16
_MOST_METADATA_BYTES = 16 << 20
_MOST_TIMES_LARGER = 256
_PIECE_BYTES = 1 << 20
_NS_PER_S = 10**9
_STAMP_ENDS = 12


class Message(NamedTuple):
    """One message, not unpacked.

    topic, kind : where it came from, and its type. bag_ns : when it was recorded. raw : its bytes. ros1 : how these are
    laid out, as ROS 1 or as ROS 2 does.
    """

    topic: str
    kind: str
    bag_ns: int
    raw: bytes
    ros1: bool

    @property
    def header_ns(self) -> int:
        """The stamp in its header, 0 where it has none; only for messages that begin with a header."""
        if len(self.raw) < _STAMP_ENDS:
            return 0
        order: Literal["big", "little"] = "big" if not self.ros1 and not self.raw[1] & 1 else "little"
        seconds, nanoseconds = (int.from_bytes(self.raw[at : at + 4], order) for at in (4, 8))
        return seconds * _NS_PER_S + nanoseconds


class Topic(NamedTuple):
    """A topic: its name, the type of its messages, and how many the bag says there are."""

    name: str
    kind: str
    total: int


def is_recording(path: Path) -> bool:
    """Whether `path` is a bag by its first bytes, or a folder with a bag's files and no images."""
    if not path.is_dir():
        return _kind_of(path) is not None
    files = _storages_in(path)
    # Many a program keeps a database; metadata say that what is damaged was a bag.
    told = bool(files) and (path / _METADATA).is_file()
    return (told or any(_holds_messages(file) for file in files)) and not image_files(path)


def is_installed() -> bool:
    """Whether the package `rosbags` is there."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        return False
    return True


class Recording:
    """The files of one bag; messages are read one at a time.

    Attributes
    ----------
    topics : the topics of the types that are read here, by name.
    foreign : how messages are serialised that are therefore not read.
    warnings : what was found wrong with the bag as a whole.

    Raises `InputError` where the package `rosbags` is not installed, and for what cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        if not is_installed():
            raise InputError(f"reading {path}: it is a ROS bag; install its reader: pip install 'scopemap[ros]'")
        bound_unpacking()
        self.path = path
        self.warnings: list[str] = []
        files, stated = self._files() if path.is_dir() else ([path], {})
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._files_read = [self._unpacked(file) if _is_packed(file) else file for file in files]
        self._bytes = sum(file.stat().st_size for file in self._files_read)
        with self.opened() as readers:
            self.topics = _topics(readers)
            self.foreign = sorted({_serialised(c) for reader in readers for c in reader.connections} - {_CDR})
        for name, count in stated.items():
            if name in self.topics and self.topics[name].total < count:
                found = self.topics[name].total
                self.warnings.append(f"{_METADATA} counts {count} messages of {name}, its files hold {found}")

    @contextmanager
    def opened(self) -> Iterator[list[Any]]:
        """Open the files, each as a reader of `rosbags` with `connections` and `messages`."""
        readers: list[Any] = []
        try:
            for file in self._files_read:
                with self._telling():
                    reader = _reader(file)
                    reader.open()
                    readers.append(reader)
            yield readers
        finally:
            for reader in readers:
                reader.close()

    def messages(
        self, readers: list[Any], topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of `topics` in the order of recording, those of [start_ns, stop_ns) only.

        Raises `InputError` where the bag breaks off.
        """
        for reader in readers:
            connections = [c for c in reader.connections if c.topic in topics and _is_read(c)]
            if not connections:
                continue
            found = reader.messages(connections, start_ns, stop_ns)
            while True:
                with self._telling():
                    item = next(found, None)
                    if item is None:
                        break
                    connection, bag_ns, raw = item
                    ros1 = not hasattr(connection.ext, "serialization_format")
                    # A message that is packed by itself looks unlike any that is not.
                    raw = unpacked_zstd(raw) if not ros1 and raw[:4] == _ZSTD else bytes(raw)
                yield Message(connection.topic, connection.msgtype, bag_ns, raw, ros1)

    def unpacked(self, message: Message) -> Any:
        """Return the message with its fields as attributes; `InputError` where it is damaged."""
        from rosbags.typesys import Stores

        with self._telling():
            if message.ros1:
                return _types(Stores.ROS1_NOETIC).deserialize_ros1(message.raw, message.kind)
            return _types(Stores.LATEST).deserialize_cdr(message.raw, message.kind)

    def believed(self, count: int) -> int | None:
        """Return a stated number of messages; None where the bag has no room for so many."""
        return count if count <= self._bytes else None

    @contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except ScopemapError:
            raise
        # Other people's parsers end in anything at all where bytes are damaged.
        except Exception as error:
            raise InputError(
                f"reading {self.path}: the bag is damaged or was not closed ({error or type(error).__name__}); 'rosbag "
                "reindex', 'ros2 bag reindex' or 'mcap recover' may mend it"
            ) from None

    def _files(self) -> tuple[list[Path], dict[str, int]]:
        """Return the files of a ROS 2 bag in order, and how many messages of each topic its metadata counts."""
        present = _storages_in(self.path)
        if not (self.path / _METADATA).is_file():
            if len(present) > 1:
                some = ", ".join(file.name for file in present[:5])
                raise InputError(
                    f"reading {self.path}: several bags and no {_METADATA} that says they are one ({some}); give one"
                )
            return present, {}
        try:
            names, stated = _metadata(self.path / _METADATA)
        except Exception as error:
            self.warnings.append(
                f"{_METADATA} cannot be read ({type(error).__name__}): all files of the folder are used"
            )
            return present, {}
        missing = [name for name in names if not (self.path / name).is_file()]
        if missing:
            self.warnings.append(f"{_METADATA} names files that are missing: {', '.join(missing[:5])}")
        kept = [self.path / name for name in names if name not in missing]
        if not kept:
            raise InputError(f"reading {self.path}: none of the {len(names)} files that its {_METADATA} names is there")
        return kept, stated

    def _unpacked(self, file: Path) -> Path:
        """Return a file that was packed as a whole, unpacked to a folder that goes with this object."""
        self._scratch = self._scratch or tempfile.TemporaryDirectory(prefix="scopemap-bag-")
        target = Path(self._scratch.name) / file.stem
        most = min(_MOST_TIMES_LARGER * file.stat().st_size, shutil.disk_usage(target.parent).free // 2)
        with self._telling(), zstandard().open(file, "rb") as packed, target.open("wb") as out:
            while piece := packed.read(_PIECE_BYTES):
                if out.tell() + len(piece) > most:
                    raise InputError(f"unpacking {file}: it would take more than {most} bytes; unpack it with zstd")
                out.write(piece)
        return target


def _kind_of(file: Path) -> str | None:
    """Return what holds the messages in a file: bag, mcap or db3; None for other files and those without permission."""
    start = _start_of(file, len(_SQLITE))
    # SQLite has other uses.
    kinds = {"bag": _ROS1, "mcap": MAGIC} | ({"db3": _SQLITE} if file.suffix == ".db3" else {})
    return next((kind for kind, magic in kinds.items() if start.startswith(magic)), None)


def _start_of(file: Path, length: int) -> bytes:
    """Return the first bytes of a file; none of one without permission, and of pipes: who opens one waits forever."""
    try:
        if not file.is_file():
            return b""
        with file.open("rb") as stream:
            return stream.read(length)
    except OSError:
        return b""


def _holds_messages(file: Path) -> bool:
    """Whether a file with a bag's ending holds one: of a database, whether it has the tables of a bag."""
    if _is_packed(file):
        return _start_of(file, len(_ZSTD)) == _ZSTD
    kind = _kind_of(file)
    return kind is not None and (kind != "db3" or _TABLES.issubset(re.findall(rb"\w+", _start_of(file, _SCHEMA_BYTES))))


def _is_packed(file: Path) -> bool:
    return file.suffix == ".zstd"


def _storages_in(folder: Path) -> list[Path]:
    suffixes = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
    return sorted((file for file in folder.iterdir() if file.name.endswith(suffixes) and file.is_file()), key=_order)


def _order(file: Path) -> list[tuple[int, int, str]]:
    return numeric_order(Path(file.name.removesuffix(".zstd")))


def _metadata(file: Path) -> tuple[list[str], dict[str, int]]:
    from ruamel.yaml import YAML

    if file.stat().st_size > _MOST_METADATA_BYTES:
        raise ValueError
    stated = YAML(typ="safe", pure=True).load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    topics = stated.get("topics_with_message_count", [])
    counts = {str(topic["topic_metadata"]["name"]): int(topic["message_count"]) for topic in topics}
    return [PurePosixPath(name).name for name in stated["relative_file_paths"]], counts


def _reader(file: Path) -> Any:
    import rosbags.rosbag1
    import rosbags.rosbag2

    match _kind_of(file):
        case "bag":
            return rosbags.rosbag1.Reader(file)
        case "mcap":
            check_profile(file)
            return rosbags.rosbag2.Reader.STORAGE_PLUGINS[".mcap"](file)
        case "db3":
            # `rosbags` makes the name into an address, where these characters mean other things.
            return rosbags.rosbag2.Reader.STORAGE_PLUGINS[".db3"](Path(quote(str(file.resolve()))))
    raise InputError(f"reading {file}: neither a ROS 1 bag nor MCAP nor SQLite")


def _is_read(connection: Any) -> bool:
    return connection.msgtype in (IMAGE, COMPRESSED, CAMERA_INFO) and _serialised(connection) == _CDR


def _serialised(connection: Any) -> str:
    """Return how messages are laid out; those of ROS 1, which has one way only, count as read."""
    return str(getattr(connection.ext, "serialization_format", _CDR))[:_LONGEST_WORD]


def _topics(readers: list[Any]) -> dict[str, Topic]:
    found: dict[str, Topic] = {}
    for connection in (c for reader in readers for c in reader.connections if _is_read(c)):
        before = found.get(connection.topic)
        count = connection.msgcount + (before.total if before else 0)
        found[connection.topic] = Topic(connection.topic, connection.msgtype, count)
    return {name: topic for name, topic in found.items() if topic.total > 0}


def _types(store: Any) -> Any:
    from rosbags.typesys import get_typestore

    if store not in _STORES:
        _STORES[store] = get_typestore(store)
    return _STORES[store]


_STORES: dict[Any, Any] = {}
