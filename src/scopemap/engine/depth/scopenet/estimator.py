"""ScopeNet behind the `DepthEstimator` contract: the weights that come with the package, or others of the same network.

The network is an ONNX graph (`training/export.py` writes it) and runs in ONNX Runtime, in float32. It estimates ln of
the distance along the ray and ln of the Laplace scale b of its error. Depth is distance times the z of the unit ray. A
Laplace distribution has the standard deviation sqrt(2) b; of a logarithm it is, to first order, the relative one of
distance, and so of depth. A second output, which other networks of the class may lack, is the probability of an
instrument, at half the size.
"""

from __future__ import annotations

import math
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.scopenet.planes import INSTRUMENTS, PLANES, STRIDE, input_planes, one_colour
from scopemap.engine.errors import SettingsError, WeightsError
from scopemap.engine.frame import Frame
from scopemap.engine.models import weights
from scopemap.engine.models.device import cpu_threads, open_network, runtime_of

if TYPE_CHECKING:
    import onnxruntime

WEIGHTS_NAME = "scopenet.onnx"
_INPUT = "planes"
_AS_THEY_COME = "that come with the package"
# Size of the second answer's picture; chosen among some eighty combinations on real clips (docs/models/scopenet.md).
_LARGER = 1.25


class ScopeNetDepth:
    """Depth estimator around a ScopeNet.

    model : the network, a .onnx file; "": that of the package.
    rays_known : whether the frames' camera is calibrated. False: the network gets no ray directions, as in
        part of its training; depth is still distance times the z of the assumed camera's ray.
    threads : of the network; 0: one for each core. device : as `open_network` takes it.
    averaged : whether depth is the mean, in ln, of the picture in one colour, and in grey, mirrored and larger by a
        quarter: errors that depend on hue, side and size cancel in part, for three times the time.

    Raises `WeightsError` where the file is missing, cannot be read, or holds another network, `SettingsError` where the
    network cannot run on the device.
    """

    name = "scopenet"

    def __init__(
        self,
        model: str = "",
        *,
        rays_known: bool = True,
        threads: int = 0,
        averaged: bool = False,
        device: str = "auto",
    ) -> None:
        self._rays_known, self._averaged = rays_known, averaged
        with resources.as_file(resources.files(__package__) / WEIGHTS_NAME) as embedded:
            file = Path(model).expanduser() if model else embedded
            self._session = load_network(file, threads, device)
            self._origin = {"model": model or _AS_THEY_COME, f"sha256 {file.name}": weights.sha256_of(file)}

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return depth, mm, of the frame's size, with its standard deviation, mm, of every pixel; and instruments.

        The mask is an input plane; depth of masked pixels is extrapolated from their surroundings.
        """
        unit_rays = _unit_rays(frame.camera)
        told_rays = unit_rays if self._rays_known else None
        answer, instruments = _answer(self._session, input_planes(frame.rgb, told_rays, frame.valid))
        log_distance, log_spread = self._mean_answer(frame, told_rays) if self._averaged else answer
        depth_mm = np.exp(log_distance) * unit_rays[..., 2]
        sigma_mm = depth_mm * np.float32(math.sqrt(2.0)) * np.exp(log_spread)
        return DepthEstimate(depth_mm, "depth", sigma=sigma_mm, instruments=instruments)

    def _mean_answer(self, frame: Frame, told_rays: np.ndarray | None) -> np.ndarray:
        coloured, grey = one_colour(frame.rgb, frame.valid)
        height, width = frame.valid.shape
        planes = input_planes(grey, told_rays, frame.valid)
        planes[4] *= -1  # mirrored rays
        mirrored = _resized(planes[..., ::-1], (round(_LARGER * width), round(_LARGER * height)))
        second = _resized(_answer(self._session, mirrored)[0], (width, height))[..., ::-1]
        first, _ = _answer(self._session, input_planes(coloured, told_rays, frame.valid))
        return np.float32(0.5) * (first + second)

    def provenance(self) -> dict[str, str]:
        """Return the name, the weights with their hash, the runtime, whether the rays were given, and if averaged."""
        rays = "known" if self._rays_known else "assumed"
        origin = {"depth": self.name, **self._origin, "runtime": runtime_of(self._session), "rays": rays}
        return origin | ({"answers": "mean of two"} if self._averaged else {})


def load_network(file: Path, threads: int = 0, device: str = "auto") -> onnxruntime.InferenceSession:
    """Return a network that takes planes (1, 8, H, W) to (1, 2, H, W), float32, H and W multiples of `STRIDE`.

    threads : 0: one for each core. device : as `open_network` takes it. Raises `WeightsError` where the file is
    missing, cannot be read, or holds another network or weights that are not finite.
    """
    if not file.is_file():
        raise WeightsError(_missing(file))
    return _loaded(file, threads or cpu_threads(), device, file.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _loaded(file: Path, threads: int, device: str, _: int) -> onnxruntime.InferenceSession:
    """Return a network, the same for runs that follow each other in one process, until its file changes."""
    try:
        session = open_network(file.read_bytes(), threads, device)
        answer = _answer(session, np.zeros((PLANES, STRIDE, STRIDE), np.float32))[0]
    except SettingsError:
        raise
    except Exception as error:  # the runtime raises a dozen kinds that share no other root
        reason = " ".join(str(error).split())
        raise WeightsError(f"cannot load ScopeNet from {file}: {reason}. Name another file in depth.model") from None
    if answer.shape != (2, STRIDE, STRIDE) or not np.isfinite(answer).all():
        raise WeightsError(f"the network in {file} is not a ScopeNet that can be used. Name another in depth.model")
    return session


def _answer(session: onnxruntime.InferenceSession, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the network's (2, H, W) for planes (8, H, W) of any H and W, and instruments (H, W) or None."""
    height, width = planes.shape[1:]
    padded = np.pad(planes, ((0, 0), (0, -height % STRIDE), (0, -width % STRIDE)))
    answer, *others = session.run(None, {_INPUT: padded[None]})
    depth: np.ndarray = answer[0, :, :height, :width]
    if INSTRUMENTS not in [output.name for output in session.get_outputs()]:
        return depth, None
    instruments = cv2.resize(others[0][0, 0], padded.shape[:0:-1], interpolation=cv2.INTER_LINEAR)
    return depth, np.asarray(instruments[:height, :width])


def _resized(planes: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return planes (N, H, W) at another size, width and height, px."""
    return cv2.resize(np.ascontiguousarray(planes.transpose(1, 2, 0)), size).transpose(2, 0, 1)


def _missing(file: Path) -> str:
    if file.name == WEIGHTS_NAME and file.parent == Path(__file__).parent:
        return (
            f"loading ScopeNet: this installation lacks {file}, which the package comes with; install it again, name a "
            ".onnx file in depth.model, or choose depth.backend=shading"
        )
    return f"loading ScopeNet: depth.model names {file}, which is no file; it must be a .onnx file"


@lru_cache(maxsize=2)
def _unit_rays(camera: PinholeCamera) -> np.ndarray:
    """Directions of the pixels' rays, (H, W, 3) float32, of length 1."""
    return camera.rays / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
