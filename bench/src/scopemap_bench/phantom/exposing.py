"""What a real camera adds to still pictures: motion during the exposure, gains that follow late, video coding."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext

from scopemap.cameras.camera import CameraModel
from scopemap.errors import SettingsError
from scopemap.geometry.se3 import inverse, mean_near, transform
from scopemap_bench.phantom.march import SurfaceBuffers, rays_of

MAX_SAMPLES = 8
"""Of light within one exposure."""

_SHIFT_PERCENTILE = 95
_PX_PER_SAMPLE = 2.0
_ENCODER = "libx264"
# Endoscopy towers record live: no frames from the future, a full frame every two seconds.
_OPTIONS = {"preset": "fast", "tune": "zerolatency"}
_FULL_EVERY = 60


def pose_at(poses: np.ndarray, time: float) -> np.ndarray:
    """Return the pose (4, 4) at a time in frames, between the poses (N, 4, 4) before and after; held at the ends."""
    first = int(np.clip(np.floor(time), 0, max(len(poses) - 2, 0)))
    share = float(np.clip(time - first, 0, 1))
    last = min(first + 1, len(poses) - 1)
    return poses[first] if share == 0 else mean_near(poses[first], [poses[last]], [share])


def exposure_times(
    index: int, shutter: float, poses: np.ndarray, surface: SurfaceBuffers, camera: CameraModel
) -> list[float]:
    """Return the times, in frames, at which the light of frame `index` is sampled; `[index]` where nothing moves.

    The shutter is open for a share `shutter` of the interval between frames, centred at the frame's pose. There is
    one sample for every 2 px that most pixels move while it is open, 8 at most.
    """
    start, end = (pose_at(poses, index + half) for half in (-0.5 * shutter, 0.5 * shutter))
    rows, columns = np.arange(0, camera.height, 4), np.arange(0, camera.width, 4)
    seen = surface.depth_mm[np.ix_(rows, columns)].astype(np.float64)
    points = transform(poses[index], (rays_of(camera)[np.ix_(rows, columns)] * seen[..., None])[np.isfinite(seen)])
    pixels = []
    for pose in (start, end):
        local = transform(inverse(pose), points)
        pixels.append(camera.project(local))
    shift_px = np.linalg.norm(pixels[1] - pixels[0], axis=1)
    shift_px = shift_px[np.isfinite(shift_px)]
    wanted = float(np.percentile(shift_px, _SHIFT_PERCENTILE)) if len(shift_px) else 0.0
    samples = int(np.clip(np.ceil(wanted / _PX_PER_SAMPLE), 1, MAX_SAMPLES))
    return [index + shutter * ((n + 0.5) / samples - 0.5) for n in range(samples)]


def lagging_gains(wanted: np.ndarray, lag_frames: float) -> np.ndarray:
    """Return gains (N,) that follow those wanted (N,) with a time constant in frames, as a camera's control does.

    The logarithm of the gain is filtered: a control loop works in stops.
    """
    share = 1 - np.exp(-1 / lag_frames) if lag_frames > 0 else 1.0
    log = np.log(np.asarray(wanted, np.float64))
    for n in range(1, len(log)):
        log[n] = log[n - 1] + share * (log[n] - log[n - 1])
    return np.exp(log)


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
