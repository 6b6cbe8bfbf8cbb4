"""Write a phantom as a C3VD folder, with a calibration file and the true surface beside the frames.

0000_color.png  0000_depth.tiff  pose.txt  camera.yaml  mesh_truth.ply  [mesh_truth/0000.ply]  displacement_truth.npz
[lesions/truth.json  lesions/1/0000.png]  phantom.json

`displacement_truth.npz` follows material points: `positions_mm` (frames, points, 3) float32, world mm, where points of
the tissue that was seen, the same ones in all frames, are in each. `lesions/N` has the masks, 255, of the polyp N in
the frames that see it; `truth.json` the sizes of each at rest, mm and mm2, over its whole surface.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh import marching_cubes
from scopemap.engine.geometry.lesion_shape import extents
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.decoding import write_encoded
from scopemap_bench.phantom.march import Volume
from scopemap_bench.phantom.render import Phantom, prepare, render_frame
from scopemap_bench.phantom.shading import VideoCoding
from scopemap_bench.phantom.slit import crossed
from scopemap_bench.phantom.spec import PhantomSpec

CLIPPED = 65535
DISPLACEMENT = "displacement_truth.npz"
_OWN_FILES = (
    "*_color.png",
    "*_depth.tiff",
    "pose.txt",
    "camera.yaml",
    "mesh_truth.ply",
    "mesh_truth/*.ply",
    DISPLACEMENT,
    "lesions/truth.json",
    "lesions/*/*.png",
)
_FOLLOWED_POINTS = 1000
_NEWTON_STEPS = 4
_BESIDE_MM = 2.0
_SEEN_MARGIN_VOXELS = 2
_RIM_VOXELS = 4


def seen_surface(volume: Volume, seen: np.ndarray) -> trimesh.Trimesh:
    """Return the true surface at rest in the voxels `seen` (X, Y, Z) bool and a rim of 2 around them, world mm.

    Vertices are exact to 1e-4 mm, faces counter-clockwise seen from the camera. `InputError` where there is no surface.
    """
    # The spline is defined where the whole neighbourhood of a voxel is inside the grid.
    inner = (slice(_RIM_VOXELS, -_RIM_VOXELS),) * 3
    where = np.zeros(seen.shape, bool)
    where[inner] = ndimage.binary_dilation(seen, iterations=_SEEN_MARGIN_VOXELS)[inner]
    values = volume.coefficients
    for axis in range(3):
        values = ndimage.convolve1d(values, np.array([1, 4, 1]) / 6, axis=axis, mode="nearest")
    if not where.any() or values[where].min() > 0 or values[where].max() < 0:
        raise InputError("no tissue is in sight of the camera path: nothing to make a true mesh of")
    vertices, faces = marching_cubes(values, where[1:, 1:, 1:])
    points = _onto_surface(volume, vertices * volume.voxel_mm + volume.origin_mm)
    return trimesh.Trimesh(points, faces, process=False)


def _onto_surface(volume: Volume, points: np.ndarray) -> np.ndarray:
    for _ in range(_NEWTON_STEPS):
        value, gradient = volume.values_at(points)
        shift = -(value / (gradient**2).sum(1))[:, None] * gradient
        points = points + np.clip(np.nan_to_num(shift), -0.5 * volume.voxel_mm, 0.5 * volume.voxel_mm)
    return points


def write_phantom(spec: PhantomSpec, folder: Path, progress: Callable[[int, int], None] | None = None) -> None:
    """Render the phantom of `spec` into `folder`, calling `progress(frames done, frames in all)` after each frame.

    Raises `InputError` for a folder that holds other files, and for an unusable path file.
    """
    folder = Path(folder)
    _check_free(folder)
    phantom = prepare(spec)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in chain.from_iterable(folder.glob(pattern) for pattern in _OWN_FILES):
            file.unlink()
        _write_description(phantom, folder / "phantom.json")
        # C3VD's lines: 16 numbers, transposed, so that the translation is the last row.
        rows = phantom.poses.transpose(0, 2, 1).reshape(-1, 16)
        np.savetxt(folder / "pose.txt", rows, fmt="%.9g", delimiter=",")
        write_calibration(spec.camera, folder / "camera.yaml", spec.depth_scale_mm, rate_hz=spec.fps)
        seen = np.zeros(phantom.volume.coefficients.shape, bool)
        coding = None if spec.h264_crf is None else VideoCoding(spec.h264_crf, spec.width, spec.height)
        for index in range(len(phantom.poses)):
            rgb, surface = render_frame(phantom, index)
            seen[phantom.volume.cells_of(surface.rest_mm)] = True
            rgb = rgb if coding is None else coding(rgb)
            write_encoded(folder / f"{index:04d}_color.png", rgb[..., ::-1])
            write_encoded(folder / f"{index:04d}_depth.tiff", encode_depth(surface.depth_mm, spec.depth_scale_mm))
            if phantom.polyps is not None:
                _write_masks(phantom.polyps.labels(surface.rest_mm), folder / "lesions", index)
            if progress is not None:
                progress(index + 1, len(phantom.poses))
        if phantom.polyps is not None:
            lesions = [_true_lesion(phantom, number) for number in range(len(spec.polyps))]
            (folder / "lesions").mkdir(exist_ok=True)
            (folder / "lesions" / "truth.json").write_text(json.dumps(lesions, indent=2) + "\n", encoding="utf-8")
        mesh = seen_surface(phantom.volume, seen)
        # Nothing is stretched across a slit, at no time: meshes of all frames have the same faces.
        parted = crossed(phantom.motion.at(len(phantom.poses)).slits, np.asarray(mesh.vertices), mesh.faces)
        mesh.update_faces(~parted)
        _write_meshes(phantom, mesh, folder)
        np.savez_compressed(folder / DISPLACEMENT, positions_mm=_followed(phantom, np.asarray(mesh.vertices)))
    except OSError as error:
        raise InputError(f"cannot write the phantom to {folder}: {error}") from None


def encode_depth(depth_mm: np.ndarray, scale_mm: float) -> np.ndarray:
    """Return depth (H, W) in mm, NaN = unknown, as uint16: 0 = unknown, 65535 = too far, else units of `scale_mm`."""
    units = np.clip(np.rint(np.nan_to_num(depth_mm.astype(np.float64)) / scale_mm), 1, CLIPPED)
    return np.where(np.isnan(depth_mm), 0, units).astype(np.uint16)


def _check_free(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write a phantom to {folder}: it is a file; name a new folder")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "phantom.json").is_file():
        raise InputError(f"will not write a phantom into {folder}: it holds other files; name a new or empty folder")


def _write_meshes(phantom: Phantom, mesh: trimesh.Trimesh, folder: Path) -> None:
    mesh.export(folder / "mesh_truth.ply")
    if phantom.motion.parts:
        (folder / "mesh_truth").mkdir(exist_ok=True)
        for index in range(len(phantom.poses)):
            moved = phantom.motion.at(index).move(np.asarray(mesh.vertices))
            trimesh.Trimesh(moved, mesh.faces, process=False).export(folder / "mesh_truth" / f"{index:04d}.ply")


def _write_masks(labels: np.ndarray, folder: Path, index: int) -> None:
    for number in np.unique(labels[labels > 0]):
        (folder / str(number)).mkdir(parents=True, exist_ok=True)
        write_encoded(folder / str(number) / f"{index:04d}.png", np.where(labels == number, 255, 0).astype(np.uint8))


def _true_lesion(phantom: Phantom, number: int) -> dict[str, object]:
    """Return the sizes of a polyp at rest: its extents, area, height over the wall."""
    polyps = phantom.polyps
    assert polyps is not None
    one = polyps.grown[number]
    fine = [_finely(volume, one.point_mm, one.reach_mm + _BESIDE_MM) for volume in (phantom.volume, polyps.wall)]
    points, wall = (np.asarray(mesh.vertices) for mesh in fine)
    own = polyps.labels(points) == number + 1
    lesion = points[own]
    largest, cross = extents(lesion)
    return {
        "kind": one.polyp.kind,
        "diameter_mm": largest,
        "cross_diameter_mm": cross,
        "area_mm2": float(fine[0].area_faces[own[fine[0].faces].mean(axis=1) > 0.5].sum()),
        "height_mm": float(cKDTree(wall).query(lesion)[0].max()),
        "middle_mm": one.point_mm.tolist(),
    }


def _finely(volume: Volume, middle_mm: np.ndarray, radius_mm: float) -> trimesh.Trimesh:
    """Return the surface in a cube, of triangles a quarter of a voxel wide."""
    low = np.floor((middle_mm - radius_mm - volume.origin_mm) / volume.voxel_mm).astype(int).clip(0)
    high = np.ceil((middle_mm + radius_mm - volume.origin_mm) / volume.voxel_mm).astype(int) + 1
    block = np.zeros(volume.coefficients.shape, bool)
    block[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    mesh = seen_surface(volume, block).subdivide().subdivide()
    return trimesh.Trimesh(_onto_surface(volume, np.asarray(mesh.vertices)), mesh.faces, process=False)


def _followed(phantom: Phantom, rest_mm: np.ndarray) -> np.ndarray:
    """Return where some of the rest points (N, 3) are in each frame, (frames, points, 3) float32."""
    rng = np.random.default_rng((phantom.spec.seed, 6))
    chosen = rest_mm[np.sort(rng.choice(len(rest_mm), min(_FOLLOWED_POINTS, len(rest_mm)), replace=False))]
    return np.stack([phantom.motion.at(i).move(chosen) for i in range(len(phantom.poses))]).astype(np.float32)


def _write_description(phantom: Phantom, file: Path) -> None:
    description = {
        "made_by": f"scopemap {version('scopemap')}",
        "spec": asdict(phantom.spec),
        "frames": len(phantom.poses),
        "exposure": None if phantom.exposure is None else np.asarray(phantom.exposure).tolist(),
        "voxel_mm": phantom.volume.voxel_mm,
    }
    file.write_text(json.dumps(description, indent=2, default=str) + "\n", encoding="utf-8")
