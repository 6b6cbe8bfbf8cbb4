"""Phantom: a scene, a camera path and a light; each frame with its exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import InputError
from scopemap.phantom.camera_path import lumen_path, sweep_path
from scopemap.phantom.cavity import laparoscopy_volume
from scopemap.phantom.deformation import REST, Breathing, Displacement, breathing
from scopemap.phantom.lumen import colon_volume, tube_volume
from scopemap.phantom.march import SurfaceBuffers, march
from scopemap.phantom.shading import AppearanceBuffers, develop, disturb, exposure_for, shade, vignette
from scopemap.phantom.spec import DEFAULT_FRAMES, PhantomSpec
from scopemap.phantom.texture import Appearance
from scopemap.phantom.volume import Volume
from scopemap.trajectory.formats.text import read_poses

_COLON_RGB = np.array([0.64, 0.265, 0.165])
_TUBE_RGB = np.array([0.55, 0.30, 0.22])


@dataclass(frozen=True)
class PhantomScene:
    """Shape and appearance of the tissue at rest."""

    volume: Volume
    appearance: Appearance


@dataclass(frozen=True)
class Phantom:
    """A scene with the path through it, ready to be rendered frame by frame.

    Attributes
    ----------
    spec : what it was made from.
    scene : tissue at rest.
    poses : (N, 4, 4) float64, camera to world, mm.
    breath : how the tissue moves.
    exposure : gain of every frame; None: each frame has its own.
    """

    spec: PhantomSpec
    scene: PhantomScene
    poses: np.ndarray
    breath: Breathing
    exposure: float | None


def prepare(spec: PhantomSpec) -> Phantom:
    """Return the phantom of `spec`: path read or generated, scene built around it, exposure set by the first frame.

    Raises `InputError` where the path file cannot be used or holds fewer poses than the frames wanted.
    """
    poses = camera_path(spec)
    scene = build_scene(spec, poses)
    breath = breathing(spec.breath_mm if spec.deform else 0.0, spec.breath_frames, spec.seed)
    radiance = light(scene, spec.camera, poses[0])[0]
    return Phantom(spec, scene, poses, breath, None if spec.auto_exposure else exposure_for(radiance))


def camera_path(spec: PhantomSpec) -> np.ndarray:
    """Return the poses (N, 4, 4) of `spec`, camera to world, mm: from its file, or generated for its scene."""
    if spec.path_file is None:
        frames = spec.frames or DEFAULT_FRAMES
        if spec.scene == "laparoscopy":
            return sweep_path(frames, spec.loop, spec.seed)
        return lumen_path(frames, spec.loop, spec.seed, straight=spec.scene == "tube")
    poses = read_poses(spec.path_file)
    if spec.frames is not None and spec.frames > len(poses):
        raise InputError(
            f"{spec.path_file} holds {len(poses)} poses, {spec.frames} frames were asked for: ask for fewer"
        )
    return poses[: spec.frames]


def build_scene(spec: PhantomSpec, poses: np.ndarray) -> PhantomScene:
    """Return the scene of `spec` built around the poses (N, 4, 4)."""
    if spec.scene == "colon":
        return PhantomScene(colon_volume(poses, spec.seed), Appearance(_COLON_RGB, spec.texture, spec.gloss, spec.seed))
    if spec.scene == "laparoscopy":
        volume, tint = laparoscopy_volume(poses, spec.seed)
        return PhantomScene(volume, Appearance(tint, spec.texture, spec.gloss, spec.seed))
    return PhantomScene(tube_volume(poses), Appearance(_TUBE_RGB, 0.0, 0.0, spec.seed))


def light(
    scene: PhantomScene, camera: PinholeCamera, T_world_camera: np.ndarray, displacement: Displacement = REST
) -> tuple[np.ndarray, SurfaceBuffers]:
    """Return linear light (H, W, 3) float32 behind the lens, before exposure, and the surface that it came from."""
    surface = march(scene.volume, camera, T_world_camera, displacement)
    footprint = surface.distance_mm / np.float32(camera.fx)
    appearance = scene.appearance
    rest = surface.rest_mm
    look = AppearanceBuffers(
        appearance.albedo(rest, footprint), appearance.ripple(rest, footprint), appearance.film(rest)
    )
    return shade(surface, look, camera) * vignette(camera), surface


def render_frame(phantom: Phantom, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frame `index` as sRGB (H, W, 3) uint8 and its true depth (H, W) float32, mm, NaN where nothing is hit."""
    rgb, surface = render_surface(phantom, index)
    return rgb, surface.depth_mm


def render_surface(phantom: Phantom, index: int) -> tuple[np.ndarray, SurfaceBuffers]:
    """Return frame `index` as sRGB (H, W, 3) uint8 and the surface that it shows."""
    spec = phantom.spec
    linear, surface = light(phantom.scene, spec.camera, phantom.poses[index], phantom.breath.at(index))
    gain = exposure_for(linear) if phantom.exposure is None else phantom.exposure
    rng = np.random.default_rng((spec.seed, 4, index))
    kinds = {event.kind for event in spec.events if event.covers(index)}
    return develop(disturb(linear * np.float32(gain), kinds, rng), spec.noise, rng), surface
