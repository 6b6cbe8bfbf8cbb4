"""Video coding: what H.264 leaves of the frames, one by one as a recorder writes them."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext

from scopemap.errors import SettingsError

_ENCODER = "libx264"
# Endoscopy towers record live: no frames from the future, a full frame every two seconds.
_OPTIONS = {"preset": "fast", "tune": "zerolatency"}
_FULL_EVERY = 60


class VideoCoding:
    """Encodes and decodes frames in order; equal frames give equal results, since it uses one thread.

    crf : constant rate factor of H.264, 0 (lossless but for the colours' resolution) to 51; 23 is usual, larger is
    coarser. Raises `SettingsError` where PyAV comes without an H.264 encoder.
    """

    def __init__(self, crf: int, width: int, height: int) -> None:
        if _ENCODER not in av.codecs_available:
            raise SettingsError("the phantom's h264_crf needs PyAV with libx264: install the wheel from PyPI")
        # 4:2:0 needs even sizes: a last row or column is repeated.
        self._width, self._height = width + width % 2, height + height % 2
        encoder, decoder = av.CodecContext.create(_ENCODER, "w"), av.CodecContext.create("h264", "r")
        assert isinstance(encoder, VideoCodecContext)
        encoder.width, encoder.height, encoder.pix_fmt = self._width, self._height, "yuv420p"
        encoder.time_base, encoder.gop_size, encoder.thread_count = Fraction(1, 30), _FULL_EVERY, 1
        encoder.options = _OPTIONS | {"crf": str(crf)}
        decoder.thread_count = 1
        decoder.flags |= av.codec.context.Flags.low_delay
        self._encoder, self._decoder = encoder, decoder

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Return the next frame (H, W, 3) uint8 after coding."""
        height, width = rgb.shape[:2]
        padded = np.pad(rgb, ((0, self._height - height), (0, self._width - width), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(padded, format="rgb24")
        packets = self._encoder.encode(frame)
        decoded = [picture for packet in packets for picture in self._decoder.decode(packet)]
        if len(decoded) != 1:
            raise RuntimeError("the H.264 decoder holds frames back")
        return decoded[0].to_ndarray(format="rgb24")[:height, :width]
