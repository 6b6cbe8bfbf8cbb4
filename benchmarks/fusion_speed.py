"""Time of fusing one 337x270 frame (depth about 15..100 mm, voxel 1 mm, truncation 5 mm) and of extracting the mesh.

Run as `python benchmarks/fusion_speed.py [FRAMES]`; kernels are compiled before the clock starts.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import FusionSettings
from scopemap.frame import Frame
from scopemap.fusion.volume import TsdfVolume
from scopemap.geometry.se3 import se3, so3_exp, transform

SETTINGS = FusionSettings(voxel_mm=1.0)

CAMERA = PinholeCamera(200.6, 200.5, 167.0, 136.7, 337, 270)
RADIUS_MM = 20.0
REACH_MM = 100.0


def tube_frame(index: int) -> Frame:
    """Return a view along a straight tube, swaying a little, 0.5 mm further on with each frame."""
    sway = so3_exp(np.array([0.3 * np.sin(index / 7), 0.3 * np.cos(index / 9), 0.02 * index]))
    T_world_camera = se3(sway, np.array([3 * np.sin(index / 5), 3 * np.cos(index / 5), 0.5 * index]))
    origin, rays = T_world_camera[:3, 3], CAMERA.rays @ T_world_camera[:3, :3].T
    a = (rays[..., :2] ** 2).sum(-1)
    b, c = rays[..., :2] @ origin[:2], origin[:2] @ origin[:2] - RADIUS_MM**2
    depth_mm = (np.sqrt(b * b - a * c) - b) / a
    depth_mm[depth_mm > REACH_MM] = np.nan
    angle = np.arctan2(*np.moveaxis(transform(T_world_camera, CAMERA.rays * depth_mm[..., None])[..., :2], -1, 0))
    stripes = np.nan_to_num(128 + 100 * np.sin(6 * angle))
    rgb = np.stack([stripes, 0.5 * stripes, 0.4 * stripes], -1).astype(np.uint8)
    valid = np.ones(depth_mm.shape, bool)
    return Frame(index, index / 30, rgb, CAMERA, valid, depth_mm.astype(np.float32), T_world_camera)


def main(count: int) -> None:
    """Fuse `count` frames and print the figures."""
    frames = [tube_frame(index) for index in range(count)]
    TsdfVolume(SETTINGS).integrate(frames[0])
    volume, times_ms = TsdfVolume(SETTINGS), []
    for frame in frames:
        start = time.perf_counter()
        volume.integrate(frame)
        times_ms.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    mesh = volume.extract_mesh()
    extraction_s = time.perf_counter() - start
    error_mm = np.abs(np.linalg.norm(mesh.vertices[:, :2], axis=1) - RADIUS_MM)
    depth_mm = np.concatenate([frame.depth_mm[np.isfinite(frame.depth_mm)] for frame in frames])
    print(f"depth {depth_mm.min():.0f}..{depth_mm.max():.0f} mm, {count} frames, {volume.block_count} blocks")
    print(f"integrate: median {np.median(times_ms):.1f} ms, 90 % {np.percentile(times_ms, 90):.1f} ms per frame")
    print(f"extract: {extraction_s:.2f} s for {len(mesh.faces)} faces; mean error {error_mm.mean():.4f} mm")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
