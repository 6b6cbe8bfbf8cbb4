"""The paper (arXiv 2508.11282) frame by frame: what the preset `paper-strict` computes, equation by equation.

    python examples/05_the_paper_frame_by_frame.py [FRAMES]

`reconstruct(FRAMES, "paper-strict")` gives the same depth and poses: test_paper_frame_by_frame.py. Where the
paper contradicts itself, docs/method.md says which reading is followed. Without arguments a tiny phantom takes the
place of FRAMES, its true disparity that of Depth Anything, shading that of Depth Pro, DIS that of RAFT, and structural
similarity that of LPIPS: no weights are needed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap import Config, Frame, ScopemapError, open_sequence
from scopemap.engine.depth.mapis import FILTER_SIGMA_MM
from scopemap.engine.depth.pseudo_stereo import AffineDisparity, fit_baseline_lbfgsb
from scopemap.engine.estimators import Estimators
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.geometry.least_squares import DenseModel, Options, Problem, minimise, robust_sigma
from scopemap.engine.geometry.se3 import inverse, mean_near, orthonormalised, se3_exp
from scopemap.engine.geometry.warp import bilateral_filtered, pull
from scopemap.engine.tracking.pyramid import build_pyramid
from scopemap.engine.tracking.residuals import Loss, PyramidLevel, normal_equations, residual_images
from scopemap.engine.tracking.smoothing import OMEGA, WEIGHTS
from scopemap.runner.estimators import create_estimators
from scopemap_bench import PhantomSpec, write_phantom

FIRST_RADIUS, LEAST_SIGMA = 0.1, 1e-3  # rho: rad, and translation over mean depth; of the residuals, grey levels / 32


def paper(frames: Iterable[Frame], config: Config, networks: Estimators) -> tuple[list[Frame], TsdfVolume]:
    """Return each frame with its depth and its smoothed pose, and the surface."""
    done: list[Frame] = []
    poses: list[np.ndarray] = []  # as estimated: smoothed ones are not used again
    mde: list[np.ndarray] = []  # D_i^mde
    keyframe, T_world_keyframe = list[PyramidLevel](), np.eye(4)
    volume = TsdfVolume(config.fusion)
    for i, frame in enumerate(frames):
        # ---- MAPIS-Depth
        disparity = networks.depth.estimate(frame).values  # d_i, Depth Anything
        if i == 0:
            pro = networks.anchor.reference.estimate(frame)  # D_1 and f_pred, Depth Pro
            f_pred = pro.focal_px or frame.camera.fx
            known = np.isfinite(pro.values) & (pro.values <= config.depth.max_depth_mm)
            baseline_mm = fit_baseline_lbfgsb(pro.values[known], disparity[known], f_pred)  # (1)
            stereo = AffineDisparity.from_baseline(baseline_mm, f_pred)
        raw_mm = pro.values if i == 0 else stereo.depth_mm(disparity)  # D_i = f_pred B / d_i
        mde.append(np.where(raw_mm <= config.depth.max_depth_mm, raw_mm, np.float32(np.nan)))
        depth_mm = mde[i] if i == 0 else refined(done[i - 1].rgb, frame.rgb, mde[i - 1], mde[i], config, networks)
        frame = replace(frame, depth_mm=depth_mm)  # F_i^rgbd

        # ---- WEMA-RTDL
        current = build_pyramid(replace(frame, depth_mm=None), config.tracking)
        T_current_keyframe = aligned(keyframe, current) if keyframe else np.eye(4)
        poses.append(orthonormalised(T_world_keyframe @ inverse(T_current_keyframe)))  # (11)
        if i % config.tracking.keyframe_every == 0:  # K_j, j = 2 m
            keyframe, T_world_keyframe = build_pyramid(frame, config.tracking), poses[i]
        frame = replace(frame, T_world_camera=smoothed(poses))
        volume.integrate(frame)  # TSDF fusion
        done.append(frame)
    return done, volume


def refined(
    previous: np.ndarray, current: np.ndarray, mde_previous: np.ndarray, mde: np.ndarray, config: Config, by: Estimators
) -> np.ndarray:
    """Return the MAPIS-Depth map (H, W) of two pictures and their D^mde."""
    sigmas = config.mapis.filter_sigma_px, FILTER_SIGMA_MM
    to_previous = by.flow.estimate(current, previous)  # (U, V), RAFT; `remap` pulls, so it leads to the previous frame
    warped = bilateral_filtered(pull(mde_previous, to_previous), *sigmas)  # (2)
    score = np.float32(by.perceptual.compare(previous, current).score)  # (3): 0 where the pictures are alike
    # (4) with S as a similarity, as the text has it: the more alike, the more of the warped depth.
    weight = np.where(np.isfinite(warped), 1 - np.clip(score, 0, 1), np.float32(0))
    return np.where(weight > 0, weight * warped + (1 - weight) * mde, mde)


def aligned(keyframe: list[PyramidLevel], current: list[PyramidLevel]) -> np.ndarray:
    """Return the motion (4, 4) from the keyframe to the current camera, level by level; the last is the coarsest."""
    mean_depth_mm = float(np.nanmean(keyframe[-1].depth_mm))
    T = np.eye(4)  # x^so3 and x^se3, where the coarsest level begins
    for level in reversed(range(len(keyframe))):
        free = 3 if level == len(keyframe) - 1 else 6  # rotation alone, then rotation and translation
        T = aligned_at_level(keyframe[level], current[level], T, free, mean_depth_mm)
    return orthonormalised(T)


def aligned_at_level(
    keyframe: PyramidLevel, current: PyramidLevel, T_start: np.ndarray, free: int, mean_depth_mm: float
) -> np.ndarray:
    """Return the motion with the least photometric error by its first `free` parameters, rotation first."""
    same_light = grey = np.array([1.0, 0.0])
    loss = Loss(np.ones(2), 1e6, grey, np.array([True, False]), 0.0)  # least squares of grey values
    start = residual_images(keyframe, current, T_start, same_light, loss)  # (5), p' by the keyframe's depth
    loss = loss._replace(sigma=np.array([robust_sigma(e[np.isfinite(e)], LEAST_SIGMA) for e in start]))
    least_overlap = 0.5 * float(keyframe.weight[np.isfinite(start[0])].sum())

    def linearise(T: np.ndarray) -> DenseModel:
        # J^T J and J^T e of (5): from them `minimise` has (7) the Gauss-Newton step, (8) steepest descent and (9) the
        # dog-leg step within rho, and changes rho by what the step has gained.
        equations = normal_equations(keyframe, current, T, same_light, loss, mean_depth_mm)
        cost = equations.cost if equations.weight > least_overlap else np.inf
        return DenseModel(cost, equations.gradient[:free], equations.hessian[:free, :free])

    def retract(T: np.ndarray, step: np.ndarray) -> np.ndarray:
        # (10) for the rotation, (6) and (12) for both: on the group, where the paper adds.
        full = np.concatenate([step, np.zeros(6 - free)]) * ([1.0] * 3 + [mean_depth_mm] * 3)
        return se3_exp(full) @ T

    return minimise(Problem(linearise, retract), T_start, Options(FIRST_RADIUS, max_iterations=30)).state


def smoothed(poses: list[np.ndarray]) -> np.ndarray:
    """Return the last pose after WEMA; poses do not add, so the mean is taken on the group."""
    if len(poses) < 3:
        return poses[-1]
    s = 1 - np.exp(-(len(poses) - 1) * OMEGA)
    return mean_near(poses[-1], poses[:-4:-1], [s * weight for weight in WEIGHTS])  # (13); 1 - s is the base's


def stand_ins(frames: Path, folder: Path) -> dict[str, object]:
    """Return settings that need no weights; the true disparity of a phantom's frames is written to `folder`."""
    folder.mkdir()
    for frame, truth in open_sequence(frames):
        np.save(folder / f"{frame.index:04d}.npy", 1 / truth.depth_mm)
    depth = {"depth.backend": f"files:{folder}", "depth.files_kind": "disparity", "depth.anchor": "shading"}
    return depth | {"networks.flow": "dis", "networks.perceptual": "structure"}


def main(source: Path, settings: dict[str, object]) -> None:
    config = Config.load("paper-strict", settings=settings)
    sequence = open_sequence(source, settings=config.input)
    frames, volume = paper((frame for frame, _ in sequence), config, create_estimators(config, sequence))
    for frame in frames:
        print(f"frame {frame.index}: {np.nanmedian(frame.depth_mm):.1f} mm deep, at {frame.T_world_camera[:3, 3]} mm")
    print(f"surface: {len(volume.extract_mesh().faces)} faces")


if __name__ == "__main__":
    try:
        if len(sys.argv) > 1:
            main(Path(sys.argv[1]), {})
        else:
            with tempfile.TemporaryDirectory() as temporary:
                phantom = Path(temporary) / "phantom"
                write_phantom(PhantomSpec(frames=6, width=160, height=128), phantom)
                main(phantom, stand_ins(phantom, Path(temporary) / "disparity"))
    except ScopemapError as error:
        sys.exit(str(error))
