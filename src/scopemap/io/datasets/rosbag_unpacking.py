"""Unpacking what a ROS recording holds, up to a limit: a few bytes can claim to be gigabytes."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

# Recorders close a chunk after a megabyte or so; one message may make it longer.
LARGEST_CHUNK_BYTES = 128 << 20


def zstandard() -> Any:
    """Return the module for Zstandard: Python's own, or what `rosbags` brings along."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def unpacked_zstd(packed: bytes) -> bytes:
    """Return what `packed` holds; `ValueError` where that is more than a chunk may be, or breaks off."""
    return _at_most(zstandard().ZstdDecompressor, packed, LARGEST_CHUNK_BYTES)


def bound_unpacking() -> None:
    """Have `rosbags` unpack chunks up to the limit only: its own functions go on until memory ends.

    This acts on the whole process: whoever else reads bags through `rosbags` in it is held to the limit, too.
    """
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap as mcap

    def bounded(start: Callable[[], Any]) -> Callable[..., bytes]:
        return lambda packed, size=LARGEST_CHUNK_BYTES: _at_most(start, packed, min(size, LARGEST_CHUNK_BYTES))

    lz4_frame, zstd_frame = bounded(lz4.frame.LZ4FrameDecompressor), bounded(zstandard().ZstdDecompressor)
    ros1.decompressors.update(bz2=bounded(bz2.BZ2Decompressor), lz4=lz4_frame)
    mcap.DECOMPRESSORS.update(lz4=lz4_frame, zstd=zstd_frame)


def _at_most(start: Callable[[], Any], packed: bytes, most: int) -> bytes:
    """Unpack all streams in `packed`; `ValueError` for more than `most` bytes and for a stream that breaks off."""
    parts, held = [], 0
    while packed:
        stream = start()
        parts.append(stream.decompress(packed, max_length=most - held + 1))
        held += len(parts[-1])
        if held > most:
            raise ValueError(f"what it holds unpacks to more than {most} bytes")
        if not stream.eof:
            raise ValueError("what is packed breaks off")
        packed = stream.unused_data or b""
    return b"".join(parts)
