"""How good is depth without any download? Constant depth, shading and the embedded network on real frames; instruments.

    python -m scopemap_bench.scripts.depth_without_download --data FOLDER [--model FILE ...] [--size WxH ...]

Four scenes with true depth are seen by rectified pinholes; "wide" is trans_t1_a at 0.6 times the focal length. Dark
surround, clipped depth and instruments do not count. Each --model (weights of the network) has a row. The few constants
of shading were chosen on these very frames; the network never saw them. Sigma is judged after median scaling, by
Laplace errors of log depth: 0.76 and 0.94 of the pixels are within 1 and 2 sigma where it is right. Last table: pixels
masked as instruments, and IoU with `gt_masks`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.stats import spearmanr

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier, working_camera
from scopemap.engine.config import DepthSettings, MaskSettings
from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.masking.masker import Masker
from scopemap.input.mask_files import MaskFiles
from scopemap.input.opening import open_sequence
from scopemap_bench.datasets.c3vd import C3vdFolder
from scopemap_bench.evaluation.depth import evaluate_depth, evaluate_depth_sequence, scale_jitter
from scopemap_bench.scripts.measuring import options_of, print_head, print_row

Size = tuple[int, int]  # width and height, px
_DARK_LEVEL = 12
_CLIPPED_MM = 99.9
_INSTRUMENT_MARGIN_PX = 9
_SATURATED_LEVEL = 250
_ENDONERF_FOCAL_PX = 569.468
_TRUTH_EVERY = 6
SIZES: tuple[Size, ...] = ((160, 128), (320, 256))
Predicted = tuple[np.ndarray, np.ndarray | None]
"""Depth and, if known, its standard deviation, (H, W) mm each, NaN = unknown."""
Estimator = Callable[[Frame], Predicted]


def c3vd_frames(
    folder: Path, size: Size, zoom: float = 1.0, count: int | None = None
) -> Iterator[tuple[C3vdFolder, Frame]]:
    """Yield rectified frames of a C3VD folder, with their true depth where it has any."""
    source = C3vdFolder(folder)
    assert source.camera is not None
    rectifier = Rectifier(source.camera, working_camera(source.camera, size, zoom))
    for item in source.frames(slice(count)):
        rgb = rectifier.image(item.rgb)
        frame = Frame(item.index, item.time_s, rgb, rectifier.target, rectifier.valid & (rgb.max(-1) > _DARK_LEVEL))
        truth = source.truth(item.index)
        if truth is not None and truth.depth_mm is not None:
            frame = replace(frame, depth_mm=rectifier.nearest(truth.depth_mm))
        yield source, frame


def cecum(data: Path, size: Size) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames 0 and 1 of cecum_t1_a with the true surface points that they see."""
    folder = data / "endoscopy" / "c3vd"
    for source, frame in c3vd_frames(folder / "cecum_t1_a", size, count=2):
        cloud = trimesh.load(folder / "cecum_t1_a_gt_clouds" / f"{frame.index:04d}_depth_pcd.ply")
        points = transform(inverse(source.poses[frame.index]), np.asarray(cloud.vertices))
        depth_mm = drawn(points[(points[:, 2] > 0) & (points[:, 2] <= _CLIPPED_MM)], frame.camera)
        yield frame, np.where(frame.valid, depth_mm, np.nan)


def trans(data: Path, size: Size, zoom: float = 1.0) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield the ten frames of trans_t1_a with their exact depth."""
    for _, frame in c3vd_frames(data / "endoscopy" / "c3vd" / "trans_t1_a", size, zoom):
        assert frame.depth_mm is not None
        yield replace(frame, depth_mm=None), np.where(frame.valid, frame.depth_mm, np.nan)


def endonerf(data: Path, size: Size) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames of EndoNeRF pulling with their stereo depth, instruments left out. The camera is at rest."""
    folder = data / "endoscopy" / "endonerf" / "pulling_soft_tissues"
    camera = PinholeCamera(_ENDONERF_FOCAL_PX, _ENDONERF_FOCAL_PX, 319.5, 255.5, 640, 512).resized(*size)
    for file in sorted((folder / "images").iterdir())[::_TRUTH_EVERY]:
        number = file.name.split(".")[0]
        rgb = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        # Some depth files have 16 bit, most 8: all are mm.
        depth_mm = cv2.imread(str(folder / "depth" / f"{number}.depth.png"), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(folder / "gt_masks" / f"{number}.mask.png"), cv2.IMREAD_GRAYSCALE)
        instrument = cv2.dilate(mask, np.ones((_INSTRUMENT_MARGIN_PX,) * 2, np.uint8)) > 0
        truth_mm = np.where((depth_mm > 0) & ~instrument, depth_mm, np.nan).astype(np.float32)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        frame = Frame(int(number.split("-")[-1]), 0.0, rgb, camera, rgb.max(-1) > _DARK_LEVEL)
        yield frame, np.where(frame.valid, cv2.resize(truth_mm, size, interpolation=cv2.INTER_NEAREST), np.nan)


SCENES: dict[str, Callable[[Path, Size], Iterator[tuple[Frame, np.ndarray]]]] = {
    "cecum clouds": cecum,
    "trans_t1_a": trans,
    "trans_t1_a wide": lambda data, size: trans(data, size, 0.6),
    "endonerf pulling": endonerf,
}
"""By name: (frame, true depth (H, W) mm, NaN = unknown or not to be counted)."""


def drawn(points_mm: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return the depth (H, W) of points (N, 3) in the camera, the nearest where several share a pixel, else NaN."""
    pixels = np.rint(camera.project(points_mm)).astype(int)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    depth_mm = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    np.minimum.at(depth_mm, (pixels[inside, 1], pixels[inside, 0]), points_mm[inside, 2].astype(np.float32))
    return np.where(np.isfinite(depth_mm), depth_mm, np.nan)


@dataclass(frozen=True)
class SceneScore:
    """Figures of a scene, means over its frames; NaN where there is nothing to measure.

    abs_rel, delta : after median scaling, mean |d - g| / g and share of pixels within a factor of 1.25. metric_abs_rel
    : of the millimetres as predicted. one_scale_abs_rel : with one scale for all frames. scale_log_std : standard
    deviation over the frames of ln median(g) / median(d). saturated_ratio : abs_rel where a channel is 250 or more,
    over that elsewhere.
    rank : Spearman's correlation of the relative error with sigma / d. within_1_sigma, within_2_sigma : share of pixels
    with |ln d / g| below 1, 2 times sigma / d.
    """

    abs_rel: float
    delta: float
    metric_abs_rel: float
    one_scale_abs_rel: float
    scale_log_std: float
    saturated_ratio: float
    rank: float
    within_1_sigma: float
    within_2_sigma: float


def score_scene(frames: Sequence[Frame], truths_mm: Sequence[np.ndarray], made: Sequence[Predicted]) -> SceneScore:
    """Return the figures of predictions against true depth (H, W) mm, NaN where it is unknown or does not count."""
    pairs = [(depth_mm, truth_mm) for (depth_mm, _), truth_mm in zip(made, truths_mm, strict=True)]
    scaled = [evaluate_depth(*pair, scaling="median") for pair in pairs]
    one_scale = evaluate_depth_sequence(lambda: pairs, scaling="sequence-median").mean
    places = [
        _where(frame.rgb, truth_mm, prediction, report["scale"])
        for frame, truth_mm, prediction, report in zip(frames, truths_mm, made, scaled, strict=True)
    ]
    return SceneScore(
        _mean([report["abs_rel"] for report in scaled]),
        _mean([report["delta_1"] for report in scaled]),
        _mean([evaluate_depth(*pair)["abs_rel"] for pair in pairs]),
        one_scale.get("abs_rel", math.nan),
        scale_jitter(np.array([report["scale"] for report in scaled]))["log_std"],
        *map(_mean, zip(*places, strict=True)),
    )


def _where(rgb: np.ndarray, truth_mm: np.ndarray, prediction: Predicted, scale: float) -> tuple[float, ...]:
    """Return the saturated ratio of a frame, and rank and shares of sigma."""
    depth_mm, sigma_mm = prediction
    known = np.isfinite(truth_mm) & (depth_mm > 0)
    ratio = scale * depth_mm[known].astype(np.float64) / truth_mm[known]
    error, bright = np.abs(ratio - 1), rgb[known].max(-1) >= _SATURATED_LEVEL
    saturated = _mean(error[bright]) / _mean(error[~bright]) if bright.any() and error[~bright].any() else math.nan
    if sigma_mm is None or len(error) < 2:
        return saturated, math.nan, math.nan, math.nan
    relative = (sigma_mm / depth_mm)[known].astype(np.float64)
    varied = min(np.ptp(error), np.ptp(relative)) > 0
    rank = float(spearmanr(error, relative).statistic) if varied else math.nan
    return saturated, rank, *(_mean(np.abs(np.log(ratio)) < sigmas * relative) for sigmas in (1, 2))


def _mean(values: np.ndarray | Sequence[float]) -> float:
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else math.nan


def constant() -> Estimator:
    """Return depth that is the shading's prior everywhere."""
    return lambda frame: (np.full(frame.valid.shape, DepthSettings().shading_median_mm, np.float32), None)


def shading() -> Estimator:
    """Return depth by shading, its scale held from a sequence's first frame on."""
    estimator = ShadingDepth(DepthSettings())
    return lambda frame: (estimator.estimate(frame).values, None)


def network(model: str) -> Estimator:
    """Return the embedded network, with the package's weights where `model` is empty."""
    estimator = ScopeNetDepth(model)

    def estimate(frame: Frame) -> Predicted:
        found = estimator.estimate(frame)
        return found.values, found.sigma

    return estimate


WITHOUT_WEIGHTS: dict[str, Callable[[], Estimator]] = {
    "constant depth": constant,
    "shading": shading,
}
"""By name: makes the estimator anew for each scene, as some remember its first frame."""


def networks(models: Sequence[str]) -> dict[str, Callable[[], Estimator]]:
    """Return the embedded network with each of these weights files, by default with the package's."""
    names = {model: f"scopenet {Path(model).parent.name}/{Path(model).name}" for model in models} or {"": "scopenet"}
    return {name: partial(network, model) for model, name in names.items()}


def measure(
    data: Path, size: Size = SIZES[0], makers: Mapping[str, Callable[[], Estimator]] = WITHOUT_WEIGHTS
) -> dict[str, dict[str, SceneScore]]:
    """Return the score by scene and estimator."""
    table: dict[str, dict[str, SceneScore]] = {}
    for scene, pairs in SCENES.items():
        frames, truths_mm = zip(*pairs(data, size), strict=True)
        table[scene] = {name: score_scene(frames, truths_mm, [*map(made(), frames)]) for name, made in makers.items()}
    return table


def print_scores(size: Size, table: Mapping[str, Mapping[str, SceneScore]]) -> None:
    """Print the scores of one size."""
    heads = ("scene", f"depth, {size[0]}x{size[1]} px", "AbsRel / delta<1.25", "as predicted", "one scale")
    print_head(*heads, "std ln scale", "saturated / elsewhere", "rank of sigma", "within 1 / 2 sigma")
    for scene, scores in table.items():
        for name, s in scores.items():
            sigma = [f"{s.rank:.2f}", f"{s.within_1_sigma:.2f} / {s.within_2_sigma:.2f}"]
            cells = [f"{s.abs_rel:.3f} / {s.delta:.2f}", f"{s.metric_abs_rel:.3f}", f"{s.one_scale_abs_rel:.3f}"]
            cells += [f"{s.scale_log_std:.3f}", f"{s.saturated_ratio:.1f}" if math.isfinite(s.saturated_ratio) else ""]
            print_row(scene, name, *cells, *(sigma if math.isfinite(s.rank) else ["", ""]))


def print_instruments(data: Path, model: str) -> None:
    """Print how much of each clip is masked as instruments, as a run masks it, and IoU with true masks."""
    endoscopy = data / "endoscopy"
    pulling = endoscopy / "endonerf" / "pulling_soft_tissues"
    print_head("instruments", "frames", "masked", "most of a frame", "IoU with `gt_masks`")
    for source in (pulling, endoscopy / "video" / "laparoscopy_rvim.mp4", endoscopy / "c3vd" / "cecum_t1_a"):
        # Each fourth frame of clips without truth.
        sequence = open_sequence(source, frames=slice(None, None, None if source == pulling else 4))
        masker = Masker(MaskSettings(instruments="auto"))
        estimator = ScopeNetDepth(model, rays_known=sequence.calibrated)
        files = MaskFiles(pulling / "gt_masks", sequence.rectifier) if source == pulling else None
        shares, both, either = [], 0, 0
        for frame in sequence.frames():
            mask = masker.instruments(estimator.estimate(masker(frame)).instruments)
            true = None if files is None else files.covered(frame.index)
            shares.append(float(mask.mean()) if mask is not None else 0.0)
            if mask is not None and true is not None:
                both, either = both + np.count_nonzero(mask & true), either + np.count_nonzero(mask | true)
        iou = f"{both / either:.3f}" if either else ""
        print_row(source.stem, len(shares), f"{np.mean(shares):.1%}", f"{max(shares):.1%}", iou)


def _size(text: str) -> Size:
    width, height = map(int, text.split("x"))
    return width, height


def main() -> None:
    """Print the tables."""
    parser = options_of(__doc__, data=True)
    parser.add_argument("--model", action="append", default=[], help="weights of the network (file); repeatable")
    parser.add_argument("--size", type=_size, nargs="+", default=SIZES, metavar="WxH", help="sizes of the frames, px")
    options = parser.parse_args()
    for size in options.size:
        print_scores(size, measure(options.data, size, WITHOUT_WEIGHTS | networks(options.model)))
        print()
    print_instruments(options.data, (options.model or [""])[0])


if __name__ == "__main__":
    main()
