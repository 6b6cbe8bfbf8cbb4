"""From a surface to the picture of it: tissue's albedo and wet film, the lamp at the camera, exposure, video coding.

Irradiance falls as cosine over squared distance, in a beam also beside its axis, and a wet spot that faces the lamp
reflects it. Albedo, vessels and film are functions of the rest point, so that they move with the tissue; they fade
where a pixel is too coarse for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import av
import cv2
import numpy as np
from av.video.codeccontext import VideoCodecContext

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.errors import SettingsError
from scopemap.engine.geometry.se3 import inverse, mean_near, transform
from scopemap.engine.geometry.srgb import srgb_picture
from scopemap_bench.phantom.march import SurfaceBuffers, noise_at, rays_of
from scopemap_bench.phantom.scenes import Tint
from scopemap_bench.phantom.spec import EventName

_MOTTLES = ((22.0, 0.22), (8.0, 0.16), (3.0, 0.14), (1.2, 0.14))
_VESSEL_COLOUR = np.array([0.80, 0.42, 0.50], np.float32)
# Lattice spacing mm, width mm, depth of colour.
_VESSELS = ((17.0, 0.45, 0.75), (8.0, 0.22, 0.55))
_RIPPLE_MM = 1.9
_PUDDLE_MM = 14.0
_FILM_TILT = 0.3
_HIGHLIGHT_SHARPNESS = 350.0
_HIGHLIGHT_STRENGTH = 1.6
_VIGNETTE = 0.35
_KNEE = 0.6
_OPTICS_SIGMA_PX = 0.55
_SHOT_NOISE = 2.5
_EXPOSED_SHARE = 80.0
_EXPOSED_LEVEL = 0.48
_BLUR_PX = 13
_WATER_PX = 5.0
_WATER_LENGTH_PX = 40.0
_WATER_FRAMES = 7.0
_WATER_RGB = np.array([0.55, 0.45, 0.22], np.float32)
_SMOKE_GREY = np.array([0.42, 0.43, 0.44], np.float32)
_VEIL = 1.2  # optical depth at the usual distance, where a cloud is of density 1
MAX_SAMPLES = 8
"""Of light within one exposure."""

_SHIFT_PERCENTILE = 95
_PX_PER_SAMPLE = 2.0
_ENCODER = "libx264"
_FULL_EVERY = 60
# Endoscopy towers record live: no frames from the future, a full frame every two seconds.
_OPTIONS = {"preset": "fast", "tune": "zerolatency"}


@dataclass(frozen=True)
class Appearance:
    """Appearance of tissue: `base`, its colour, linear RGB (3,), or the colours in space; `seed` of its pattern.

    wet_seed : of its fluid.
    texture, gloss : strength of mottling and vessels, and of highlights; 0 = none.
    """

    base: np.ndarray | Tint
    texture: float
    gloss: float
    seed: int
    wet_seed: int

    def albedo(self, rest_mm: np.ndarray, footprint_mm: np.ndarray) -> np.ndarray:
        """Return linear RGB (H, W, 3) float32, 0..1, at rest points (H, W, 3) seen by pixels that wide (H, W)."""
        footprint = np.nan_to_num(footprint_mm, nan=1.0)
        colour = self.base.at(rest_mm) if isinstance(self.base, Tint) else self.base.astype(np.float32)
        if self.texture > 0:
            colour = colour * self._mottling(rest_mm, footprint) * self._vessels(rest_mm, footprint)
        return np.minimum(np.broadcast_to(colour, rest_mm.shape), 1.0)

    def ripple(self, rest_mm: np.ndarray, footprint_mm: np.ndarray) -> np.ndarray:
        """Return the tilt (H, W, 3) float32, about -1..1, of the fluid film; zero without gloss."""
        if self.gloss == 0:
            return np.zeros(rest_mm.shape, np.float32)
        axes = [noise_at(rest_mm, _RIPPLE_MM, self.wet_seed + 41 + n) for n in range(3)]
        return np.stack(axes, -1) * _visible(_RIPPLE_MM, np.nan_to_num(footprint_mm, nan=1.0))[..., None]

    def film(self, rest_mm: np.ndarray) -> np.ndarray:
        """Return the strength (H, W) float32, >= 0, of specular reflection: larger in wet places, never 0."""
        wetness = 0.5 + 1.6 * noise_at(rest_mm, _PUDDLE_MM, self.wet_seed + 45)
        return (self.gloss * np.clip(wetness, 0.05, 1.0)).astype(np.float32)

    def _mottling(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        brightness = sum(
            strength * _visible(period, footprint) * noise_at(points, period, self.seed + 31 + n)
            for n, (period, strength) in enumerate(_MOTTLES)
        )
        redness = noise_at(points, 12.0, self.seed + 36)
        tone = np.array([0.02, -0.22, -0.18], np.float32)
        return np.exp(self.texture * (brightness[..., None] + redness[..., None] * tone)).astype(np.float32)

    def _vessels(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Vessels run along the zero crossings of smooth noise; a second noise selects where."""
        stain = np.zeros(footprint.shape, np.float32)
        for n, (period, width, depth) in enumerate(_VESSELS):
            bent = points + 0.9 * noise_at(points, period / 3, self.seed + 51 + n)[..., None]
            away_mm = np.abs(noise_at(bent, period, self.seed + 53 + n)) * period / 1.6
            wide = np.hypot(width, 0.7 * footprint)
            there = np.clip(2.2 * noise_at(points, 1.7 * period, self.seed + 55 + n) + 0.25, 0, 1)
            stain += depth * there * (width / wide) * np.exp(-((away_mm / wide) ** 2))
        return _VESSEL_COLOUR ** (self.texture * stain[..., None])


def _visible(period_mm: float, footprint_mm: np.ndarray) -> np.ndarray:
    """Share (0..1) of a pattern's contrast that pixels of this width resolve."""
    return np.clip(period_mm / (2.0 * footprint_mm) - 0.5, 0.0, 1.0).astype(np.float32)


def shade(
    surface: SurfaceBuffers,
    albedo: np.ndarray,
    ripple: np.ndarray,
    film: np.ndarray,
    camera: CameraModel,
    indirect: float = 0.0,
    sent: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return linear radiance (H, W, 3) float32, per mm^2 of distance, before exposure; 0 where nothing is seen.

    `albedo` (H, W, 3) linear RGB, `ripple` (H, W, 3) tilt of the fluid film, `film` (H, W) strength of reflection.
    `indirect` : share of the lamp's light that reaches every point alike after scattering in the cavity.
    `sent` : share of the lamp's light along each ray, as `beam` returns it.
    """
    rays = rays_of(camera).astype(np.float32)
    towards = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    light = sent / surface.distance_mm[..., None] ** 2
    cosine = np.clip((surface.normal * towards).sum(-1, keepdims=True), 0, 1)
    irradiance = cosine * light
    if indirect > 0 and np.isfinite(irradiance).any():
        irradiance = irradiance + indirect * np.nanmean(irradiance)
    radiance = albedo * irradiance
    if film.any():
        wet = surface.normal + _FILM_TILT * ripple
        wet /= np.linalg.norm(wet, axis=-1, keepdims=True)
        mirrored = np.clip((wet * towards).sum(-1, keepdims=True), 0, 1) ** _HIGHLIGHT_SHARPNESS
        radiance = radiance + film[..., None] * _HIGHLIGHT_STRENGTH * mirrored * light
    return np.nan_to_num(radiance, nan=0.0, posinf=0.0).astype(np.float32)


def beam(camera: CameraModel, beam_deg: float | None) -> np.ndarray | float:
    """Return what the lamp sends along each ray, (H, W, 1) float32, 1 on its axis: 0.5 ** (2 angle / beam_deg) ** 2.

    The lamp is at the camera, its axis the optical one. beam_deg : full angle of half power, degrees; None: 1 anywhere.
    """
    if beam_deg is None:
        return 1.0
    rays = rays_of(camera)
    angle_rad = np.arctan2(np.linalg.norm(rays[..., :2], axis=-1, keepdims=True), rays[..., 2:])
    return np.exp2(-((2 * angle_rad / np.radians(beam_deg)) ** 2)).astype(np.float32)


def vignette(camera: CameraModel) -> np.ndarray:
    """Return the lens's transmission (H, W, 1) float32: 1 at the centre, less towards the corners."""
    # By the place in the image: a fisheye's widest rays have no end on the plane z = 1.
    squared = (camera.central.rays[..., :2] ** 2).sum(-1, keepdims=True)
    return 1.0 - _VIGNETTE * squared / squared.max()


def exposure_for(radiance: np.ndarray) -> float:
    """Return the gain that exposes `radiance` (H, W, 3) well: its 80th percentile at level 0.48."""
    lit = radiance.max(-1)
    lit = lit[lit > 0]
    return _EXPOSED_LEVEL / float(np.percentile(lit, _EXPOSED_SHARE)) if lit.size else 1.0


def disturb(linear: np.ndarray, kinds: set[EventName], rng: np.random.Generator, index: int = 0) -> np.ndarray:
    """Return exposed light (H, W, 3) of frame `index` seen through water, with smoke, with blur, or all black."""
    if "fluid" in kinds:
        linear = _fluid(linear, index)
    if "smoke" in kinds:
        linear = _smoke(linear, rng)
    if "blur" in kinds:
        linear = _blur(linear, rng)
    return np.zeros_like(linear) if "black" in kinds else linear


def develop(linear: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Return the 8-bit sRGB picture (H, W, 3) of exposed light: optics, sensor noise, highlight knee, sRGB curve.

    `noise` is the read noise as a share of the linear range; shot noise grows with the root of the signal.
    """
    signal = cv2.GaussianBlur(linear, (0, 0), _OPTICS_SIGMA_PX)
    if noise > 0:
        deviation = noise * np.sqrt(1.0 + _SHOT_NOISE**2 * np.clip(signal, 0, 1))
        signal = signal + deviation * rng.standard_normal(signal.shape, np.float32)
    signal = np.where(signal > _KNEE, _KNEE + 0.45 * (1 - np.exp((_KNEE - signal) / 0.45)), signal)
    return srgb_picture(np.clip(signal, 0, 1))


def _fluid(linear: np.ndarray, index: int) -> np.ndarray:
    """Bend the view by water that runs over the lens, and cloud it where it carries something along."""
    height, width = linear.shape[:2]
    px = width / 320
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    points = np.stack([x, y - 6.0 * px * index, np.full_like(x, index * _WATER_LENGTH_PX * px / _WATER_FRAMES)], -1)
    bend = [_WATER_PX * px * noise_at(points, _WATER_LENGTH_PX * px, seed).astype(np.float32) for seed in (71, 72)]
    bent = cv2.remap(linear, x + bend[0], y + bend[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    thickness = np.clip(1.4 * noise_at(points, 2 * _WATER_LENGTH_PX * px, 73), 0, 0.7)[..., None].astype(np.float32)
    return bent * (1 - thickness) + float(linear.mean()) * _WATER_RGB / _WATER_RGB.mean() * thickness


def _smoke(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = linear.shape[:2]
    coarse = rng.uniform(0.55, 0.9, (4, 5)).astype(np.float32)
    clouds = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    thickness = np.clip(clouds, 0, 1)[..., None]
    return linear * (1 - thickness) + _SMOKE_GREY * thickness


def veil(linear: np.ndarray, distance_mm: np.ndarray, share: float, time: float) -> np.ndarray:
    """Return exposed light (H, W, 3) behind smoke that gathers and clears, at a share of its time.

    distance_mm : (H, W), what is farther is behind more of it; NaN is far.
    """
    height, width = distance_mm.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    points = np.stack([x / width - 0.02 * time, y / height + 0.008 * time, np.full_like(x, 0.02 * time)], -1)
    clouds = np.clip(0.6 + noise_at(points, 0.7, 75) + 0.5 * noise_at(points, 0.25, 76), 0.05, None)
    far = np.nan_to_num(distance_mm / np.nanmedian(distance_mm), nan=2.0)
    clear = np.exp(-_VEIL * np.sin(np.pi * share) ** 2 * clouds * far)[..., None].astype(np.float32)
    return linear * clear + _SMOKE_GREY * (1 - clear)


def _blur(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Smear along a random direction, then defocus; lengths are given for 320 px and grow with the picture."""
    scale = linear.shape[1] / 320
    length = max(int(_BLUR_PX * scale), 3)
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    angle = rng.uniform(0, np.pi)
    for step in np.linspace(-length, length, 4 * length):
        kernel[round(length + step * np.sin(angle)), round(length + step * np.cos(angle))] = 1.0
    return cv2.GaussianBlur(cv2.filter2D(linear, -1, kernel / kernel.sum()), (0, 0), 3.0 * scale)


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

    The shutter is open for a share `shutter` of the interval, centred at the frame's pose: a sample every 2 px, 8 at
    most.
    """
    start, end = (pose_at(poses, index + half) for half in (-0.5 * shutter, 0.5 * shutter))
    rows, columns = np.arange(0, camera.height, 4), np.arange(0, camera.width, 4)
    seen = surface.depth_mm[np.ix_(rows, columns)].astype(np.float64)
    points = transform(poses[index], (rays_of(camera)[np.ix_(rows, columns)] * seen[..., None])[np.isfinite(seen)])
    first, last = (camera.project(transform(inverse(pose), points)) for pose in (start, end))
    shift_px = np.linalg.norm(last - first, axis=1)
    shift_px = shift_px[np.isfinite(shift_px)]
    wanted = float(np.percentile(shift_px, _SHIFT_PERCENTILE)) if len(shift_px) else 0.0
    samples = int(np.clip(np.ceil(wanted / _PX_PER_SAMPLE), 1, MAX_SAMPLES))
    return [index + shutter * ((n + 0.5) / samples - 0.5) for n in range(samples)]


def lagging_gains(wanted: np.ndarray, lag_frames: float) -> np.ndarray:
    """Return gains (N,) whose logarithm follows that of the wanted (N,) with a time constant in frames."""
    share = 1 - np.exp(-1 / lag_frames) if lag_frames > 0 else 1.0
    log = np.log(np.asarray(wanted, np.float64))
    for n in range(1, len(log)):
        log[n] = log[n - 1] + share * (log[n] - log[n - 1])
    return np.exp(log)


class VideoCoding:
    """Encodes and decodes frames in order; equal frames give equal results, since it uses one thread.

    crf : rate factor of H.264, 0 to 51; 23 is usual, larger is coarser. `SettingsError` where PyAV has no H.264
    encoder.
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
