"""Phantom: a scene, a camera path and a light; each frame with its exact truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.trajectory.text import read_poses
from scopemap_bench.phantom.instrument import Capsules, insert, instrument
from scopemap_bench.phantom.march import SurfaceBuffers, Volume, march
from scopemap_bench.phantom.motion import (
    REST,
    Grasp,
    Part,
    TissueMotion,
    breathing,
    contractions,
    cut,
    examined_again,
    grasp,
    insufflated,
    lumen_path,
    poke,
    push,
    straight_path,
    sweep_path,
    touching,
    turned,
)
from scopemap_bench.phantom.polyps import Polyps, grow
from scopemap_bench.phantom.scenes import Tint, colon_volume, laparoscopy_volume, tube_volume
from scopemap_bench.phantom.shading import (
    Appearance,
    beam,
    develop,
    disturb,
    exposure_for,
    exposure_times,
    lagging_gains,
    pose_at,
    shade,
    veil,
    vignette,
)
from scopemap_bench.phantom.slit import in_wound
from scopemap_bench.phantom.spec import DEFAULT_FRAMES, OPEN_SCENES, Event, EventName, PhantomSpec

_WOUND_RGB = np.array([0.7, 0.22, 0.2], np.float32)
_COLON_RGB = np.array([0.64, 0.265, 0.165])
_TUBE_RGB = np.array([0.55, 0.30, 0.22])
# Exposure is measured in a small picture, as cameras do.
_METERING_SHARE = 8
# Where a frame shows what is poked, over its height and width.
_POKED_AT = 0.5, 0.68
_ALONG_MM = {"sideways": np.array([22.0, 0, 0]), "withdrawal": np.array([0, 0, -52.0])}
_PUSHED_AWAY_MM = {"laparoscopy": 60.0, "lumen": 25.0}


@dataclass(frozen=True)
class Phantom:
    """A scene and the path (N, 4, 4) through it, camera to world, mm; `exposure`: of all frames, of each (N,), or None:
    own. `polyps` : those that are in `volume`.
    """

    spec: PhantomSpec
    volume: Volume
    appearance: Appearance
    poses: np.ndarray
    motion: TissueMotion
    exposure: float | np.ndarray | None
    polyps: Polyps | None = None


def prepare(spec: PhantomSpec) -> Phantom:
    """Return the phantom of `spec`: path read or generated, scene built around it, exposure set by the first frame."""
    poses = camera_path(spec)
    volume, appearance = build_scene(spec, poses)
    for event in _events(spec, "contact"):
        poses = touching(poses, event.first, event.last, lambda point: float(volume.values_at(point[None])[0][0]))
    polyps = None
    if spec.polyps:
        volume, polyps = grow(volume, spec.polyps, poses, spec.camera, spec.seed)
    if spec.examination:
        poses = examined_again(poses, spec.examination, spec.seed)
    phantom = Phantom(spec, volume, appearance, poses, _motion(spec, poses, volume), None, polyps)
    if not spec.auto_exposure:
        return replace(phantom, exposure=exposure_for(light(phantom, 0)[0]))
    return replace(phantom, exposure=_lagging_exposure(phantom)) if spec.exposure_lag_frames > 0 else phantom


def _events(spec: PhantomSpec, kind: EventName) -> list[Event]:
    return [event for event in spec.events if event.kind == kind]


def _motion(spec: PhantomSpec, poses: np.ndarray, volume: Volume) -> TissueMotion:
    """Breathing and what the events do to the tissue."""
    parts: list[Part] = []
    if spec.deform:
        parts.append(breathing(spec.breath_mm, spec.breath_frames, spec.seed))
    away_mm = _PUSHED_AWAY_MM["laparoscopy" if spec.scene in OPEN_SCENES else "lumen"]
    for event in spec.events:
        first, last, pose = event.first, event.last, poses[min(event.first, len(poses) - 1)]
        if event.kind in ("push", "rebound"):
            parts.append(push(first, last, pose, away_mm, springs=event.kind == "rebound"))
        elif event.kind == "peristalsis":
            parts.append(contractions(first, last, pose))
        elif event.kind in ("poke", "grasp", "cut"):
            point, normal, along, distance_mm = _touched(spec, event, pose, volume)
            if event.kind == "cut":
                parts.append(cut(first, last, point, along, normal, distance_mm))
            elif event.kind == "poke":
                parts.append(poke(first, last, point, (along - normal) / np.sqrt(2), distance_mm))
            else:
                parts.append(grasp(first, last, point, (along + normal) / np.sqrt(2), distance_mm))
    return TissueMotion(tuple(parts), insufflated(spec.insufflation, poses[0]) if spec.insufflation else REST)


def _touched(
    spec: PhantomSpec, event: Event, T_world_camera: np.ndarray, volume: Volume
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return what a camera sees right of its middle: point, normal, a direction along the surface (3,), depth, mm."""
    surface = march(volume, spec.camera, T_world_camera, REST)
    row, column = (round(share * side) for share, side in zip(_POKED_AT, surface.depth_mm.shape, strict=True))
    if not np.isfinite(surface.depth_mm[row, column]):
        raise InputError(f"nothing to {event.kind}: frame {event.first} shows no tissue on the right of its middle")
    normal = T_world_camera[:3, :3] @ surface.normal[row, column]
    along = np.cross(normal, T_world_camera[:3, 1])
    return surface.rest_mm[row, column], normal, along / np.linalg.norm(along), float(surface.depth_mm[row, column])


def _lagging_exposure(phantom: Phantom) -> np.ndarray:
    """Gain of each frame (N,), which follows what the frame needs with the lag of `phantom.spec`."""
    spec = phantom.spec
    width, height = (max(size // _METERING_SHARE, 16) for size in (spec.width, spec.height))
    small = replace(phantom, spec=replace(spec, width=width, height=height, shutter=0.0))
    wanted = np.array([exposure_for(light(small, index)[0]) for index in range(len(phantom.poses))])
    return lagging_gains(wanted, spec.exposure_lag_frames)


def camera_path(spec: PhantomSpec) -> np.ndarray:
    """Return the poses (N, 4, 4) of `spec`, camera to world, mm: from its file, or generated for its scene."""
    if spec.path_file is None:
        # Every `speed`-th pose of a path that is as much longer.
        frames = ((spec.frames or DEFAULT_FRAMES) - 1) * spec.speed + 1
        if spec.route != "wander":
            path = straight_path(frames, _ALONG_MM[spec.route], spec.seed)
        elif spec.scene in OPEN_SCENES:
            path = sweep_path(frames, spec.loop, spec.seed)
        else:
            path = lumen_path(frames, spec.loop, spec.seed, straight=spec.scene == "tube")
        return _with_turns(path[:: spec.speed], spec)
    poses = read_poses(spec.path_file)
    if spec.frames is not None and spec.frames > len(poses):
        wanted = f"{spec.frames} frames were asked for: ask for fewer"
        raise InputError(f"{spec.path_file} holds {len(poses)} poses, {wanted}")
    return _with_turns(poses[: spec.frames], spec)


def _with_turns(poses: np.ndarray, spec: PhantomSpec) -> np.ndarray:
    for number, event in enumerate(_events(spec, "turn")):
        poses = turned(poses, event.first, event.last, back=number % 2 == 1)
    return poses


def build_scene(spec: PhantomSpec, poses: np.ndarray) -> tuple[Volume, Appearance]:
    """Return shape and appearance of the scene of `spec`, built around the poses (N, 4, 4)."""
    if spec.scene == "tube":
        return tube_volume(poses), Appearance(_TUBE_RGB, 0.0, 0.0, spec.seed, 0)
    base: np.ndarray | Tint
    if spec.scene == "colon":
        volume, base = colon_volume(poses, spec.seed, spec.fold_mm), _COLON_RGB
    else:
        volume, base = laparoscopy_volume(poses, spec.seed, OPEN_SCENES[spec.scene], spec.omentum_mm)
    return volume, Appearance(base, spec.texture, spec.gloss, spec.seed, spec.seed + 1000 * spec.examination)


def light(phantom: Phantom, index: int) -> tuple[np.ndarray, SurfaceBuffers]:
    """Return linear light (H, W, 3) float32 of a frame, the mean over the open shutter, and the surface at its pose."""
    spec = phantom.spec
    radiance, surface = _light_at(phantom, float(index))
    if spec.shutter > 0:
        times = exposure_times(index, spec.shutter, phantom.poses, surface, spec.camera)
        if len(times) > 1:
            radiance = np.stack([_light_at(phantom, time)[0] for time in times]).mean(0, dtype=np.float32)
    return radiance, surface


def _light_at(phantom: Phantom, time: float) -> tuple[np.ndarray, SurfaceBuffers]:
    """Linear light at a moment, in frames, and the surface that it came from."""
    camera, look = phantom.spec.camera, phantom.appearance
    displacement = phantom.motion.at(time)
    surface = march(phantom.volume, camera, pose_at(phantom.poses, time), displacement)
    rest, footprint = surface.rest_mm, surface.distance_mm / np.float32(camera.central.fx)
    albedo, ripple = look.albedo(rest, footprint), look.ripple(rest, footprint)
    albedo[in_wound(displacement.slits, rest)] *= _WOUND_RGB
    if phantom.polyps is not None:
        albedo = albedo * phantom.polyps.tint(rest)
    sent = beam(camera, phantom.spec.beam_deg)
    radiance = shade(surface, albedo, ripple, look.film(rest), camera, phantom.spec.indirect, sent)
    for tool in _tools(phantom, time):
        radiance, surface = insert(tool, radiance, surface, camera, sent)
    return radiance * vignette(camera), surface


def _tools(phantom: Phantom, time: float) -> list[Capsules | None]:
    """Return the instruments at a moment, in frames; one that holds tissue has its tip where that is."""
    rigid, seed = phantom.spec.scene in OPEN_SCENES, phantom.spec.seed
    tools = [instrument(time, e.first, e.last, rigid, seed) for e in _events(phantom.spec, "instrument")]
    for part in phantom.motion.parts:
        if isinstance(part, Grasp):
            # Tissue that was let go swings back; the tip does not follow it.
            held = phantom.motion.at(min(time, part.let_go)).move(part.point_mm[None])
            held = transform(inverse(pose_at(phantom.poses, time)), held)[0]
            tools.append(instrument(time, part.first, part.last, rigid, seed, (held, part.holds(time))))
    return tools


def render_frame(phantom: Phantom, index: int) -> tuple[np.ndarray, SurfaceBuffers]:
    """Return frame `index` as sRGB (H, W, 3) uint8, before video coding, and the surface that it shows."""
    spec = phantom.spec
    linear, surface = light(phantom, index)
    gain = exposure_for(linear) if phantom.exposure is None else phantom.exposure
    gain = gain if isinstance(gain, float) else gain[index]
    rng = np.random.default_rng((spec.seed, 4, index))
    kinds = {event.kind for event in spec.events if event.first <= index <= event.last}
    linear = linear * np.float32(gain)
    for event in _events(spec, "veil"):
        if event.first <= index <= event.last:
            linear = veil(linear, surface.distance_mm, (index - event.first) / max(event.last - event.first, 1), index)
    return develop(disturb(linear, kinds, rng, index), spec.noise, rng), surface
