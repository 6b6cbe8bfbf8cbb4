"""What an MCAP file says of how its messages are laid out; `rosbags` reads those of ROS 2 alone.

Records are those of the MCAP specification: a byte for the kind, eight for the length, the content.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from scopemap.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _CHANNEL = 1, 4
_FOOTER_BYTES = 1 + 8 + 20
_ROS2 = "ros2"
_LONGEST_WORD, _MOST_RECORDS = 40, 10_000


def check_profile(file: Path) -> None:
    """Raise `InputError` that names how messages are laid out where a file says that it is of another make than ROS 2.

    A damaged file is left to the reader.
    """
    try:
        with file.open("rb") as stream:
            stream.seek(len(MAGIC))
            kind, _ = struct.unpack("<BQ", stream.read(9))
            profile = _word(stream) if kind == _HEADER else _ROS2
            if profile == _ROS2:
                return
            found = ", ".join(sorted(_encodings(stream))) or "an unknown way"
    except (OSError, struct.error, UnicodeDecodeError):
        return
    raise InputError(
        f"reading {file}: its messages are serialised as {found} (profile '{profile}'); those of ROS 2 (cdr, profile "
        f"'{_ROS2}') are read: convert it first"
    )


def _encodings(stream: BinaryIO) -> set[str]:
    """Return how the messages of the channels that the summary lists are laid out; none where there is no summary."""
    found: set[str] = set()
    end = stream.seek(-len(MAGIC) - _FOOTER_BYTES, 2)
    stream.seek(9, 1)
    (place,) = struct.unpack("<Q", stream.read(8))
    for _ in range(_MOST_RECORDS):
        if not 0 < place < end:
            break
        stream.seek(place)
        kind, length = struct.unpack("<BQ", stream.read(9))
        if kind == _CHANNEL:
            stream.seek(4, 1)
            (topic,) = struct.unpack("<I", stream.read(4))
            stream.seek(topic, 1)
            found.add(_word(stream))
        place += 9 + length
    return found


def _word(stream: BinaryIO) -> str:
    (length,) = struct.unpack("<I", stream.read(4))
    return stream.read(min(length, _LONGEST_WORD)).decode()
