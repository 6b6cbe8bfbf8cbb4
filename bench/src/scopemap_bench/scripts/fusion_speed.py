"""Processor time of fusing a 337x270 frame (depth 15..100 mm, voxel 1 mm, truncation 5 mm) and of extracting the mesh.

Run as `python -m scopemap_bench.scripts.fusion_speed [FRAMES]`: the fastest of three runs each, Open3D's beside ours
where it is
installed. Kernels are compiled before the clock starts.
"""

from __future__ import annotations

import sys
import time
from importlib.util import find_spec

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import FusionSettings
from scopemap.frame import Frame
from scopemap.fusion.surface_fusion import TsdfVolume
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform

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


def _ours(frames: list[Frame]) -> tuple[float, float, np.ndarray, int]:
    """Seconds of processor time of fusing and extracting; vertices and number of faces."""
    volume, start = TsdfVolume(SETTINGS), time.process_time()
    for frame in frames:
        volume.integrate(frame)
    fused = time.process_time()
    mesh = volume.extract_mesh()
    return fused - start, time.process_time() - fused, mesh.vertices, len(mesh.faces)


def _open3d(frames: list[Frame]) -> tuple[float, float, np.ndarray, int]:
    """The same of Open3D's VoxelBlockGrid: of its ScalableTSDFVolume 0.20 integrates one block only."""
    from open3d import core
    from open3d.t.geometry import Image, VoxelBlockGrid

    kinds, voxel_mm = (core.float32,) * 3, SETTINGS.voxel_mm
    grid = VoxelBlockGrid(("tsdf", "weight", "color"), kinds, (1, 1, 3), voxel_mm, 8, 20000, core.Device("CPU:0"))
    K = core.Tensor([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]], core.float64)
    start = time.process_time()
    for frame in frames:
        depth = Image(core.Tensor(np.nan_to_num(np.asarray(frame.depth_mm))))
        colour = Image(core.Tensor(frame.rgb.astype(np.float32) / 255))
        T = core.Tensor(inverse(np.asarray(frame.T_world_camera)))
        # Truncation: 5 voxels, as ours.
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, REACH_MM + 1, 5.0)
        grid.integrate(blocks, depth, colour, K, K, T, 1.0, REACH_MM + 1, 5.0)
    fused = time.process_time()
    mesh = grid.extract_triangle_mesh(weight_threshold=SETTINGS.advanced.min_weight)
    seconds = fused - start, time.process_time() - fused
    return *seconds, mesh.vertex.positions.numpy(), len(mesh.triangle.indices)


def main(count: int) -> None:
    """Fuse `count` frames and print the figures."""
    frames = [tube_frame(index) for index in range(count)]
    _ours(frames[:2])
    methods = {"scopemap": _ours} | ({"Open3D VoxelBlockGrid": _open3d} if find_spec("open3d") else {})
    print("| method | integrate, ms per frame | extract, ms | faces | mean error mm |\n|---|---|---|---|---|")
    for name, method in methods.items():
        fuse_s, extract_s, vertices, faces = min((method(frames) for _ in range(3)), key=lambda run: run[0])
        error_mm = np.abs(np.linalg.norm(vertices[:, :2], axis=1) - RADIUS_MM).mean()
        times = f"{1e3 * fuse_s / count:.1f} | {1e3 * extract_s:.0f}"
        print(f"| {name} | {times} | {faces} | {error_mm:.4f} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
