"""Facts in a video file's header: codec, size, rate, shape of pixels, bits, range, rotation, fields, length."""

from __future__ import annotations

from typing import Any

import av

from scopemap.input.video_format.streams import stated_length_s, video_stream

_FULL_RANGE = 2
# FFmpeg's numbers for the order of fields: 0 unknown, 1 progressive, then the four kinds of interlaced.
_PROGRESSIVE = 1


def read_container(media: str) -> dict[str, Any] | None:
    """Return the facts in the header and first picture of a video, None where it cannot be opened.

    pixel_aspect : width of a pixel over its height. bits : per colour channel. full_range : whether levels use 0..255.
    rotation_deg : by which a player rotates the picture. interlaced : by the header. A fact is None if it is not there.
    """
    try:
        with av.open(media, "r", metadata_errors="replace") as container:
            stream = video_stream(container)
            first = None if stream is None else next(container.decode(stream), None)
            if stream is None or first is None:
                return None
            length_s, is_own = stated_length_s(container, stream)
            return {
                "container": container.format.name,
                "codec": stream.codec_context.name,
                "width": first.width,
                "height": first.height,
                "rate_hz": float(stream.average_rate) if stream.average_rate else None,
                "pixel_aspect": float(stream.sample_aspect_ratio or 1),
                "pixel_format": first.format.name,
                "bits": max(component.bits for component in first.format.components),
                "full_range": first.color_range == _FULL_RANGE or first.format.name.startswith("yuvj"),
                "rotation_deg": int(first.rotation),
                "interlaced": bool(first.interlaced_frame or stream.codec_context.field_order > _PROGRESSIVE),
                "frames": stream.frames or None,
                "length_s": length_s if is_own else None,
            }
    except (av.FFmpegError, OSError, ValueError):
        return None
