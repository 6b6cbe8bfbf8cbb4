"""Render a store of frames: seed and index -> scene -> view -> buffers -> disk.

Every frame is made from its own random stream (seed, index), so it does not matter who renders it, nor when.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from training.buffers import NOISE_PERIODS, Buffers, camera_rays, create_store, open_store
from training.marching import INSTRUMENT, march_rays, shade_shadows, surface
from training.scene import AIRWAY, BAG, COLON, LAPAROSCOPY, SINUS, WALL, Scene, log_uniform
from training.scene_abdomen import laparoscopy, wall
from training.scene_cavities import bag, sinus
from training.scene_tubes import airway, colon
from training.shapes import noise_channels
from training.viewpoint import FAR, SceneView, found_well, random_tools, random_view, rotated

_NEAREST_MM, _FARTHEST_MM = 2.0, 400.0
# Median distances in mm that a kind of scene is scaled to.
_MEDIANS_MM = {COLON: (6, 90), BAG: (8, 130), AIRWAY: (6, 60), SINUS: (6, 100), LAPAROSCOPY: (16, 150), WALL: (6, 120)}
_SHARES = ((COLON, 0.35), (LAPAROSCOPY, 0.25), (WALL, 0.12), (BAG, 0.10), (AIRWAY, 0.08), (SINUS, 0.10))
MAKERS = {COLON: colon, AIRWAY: airway, BAG: bag, SINUS: sinus, LAPAROSCOPY: laparoscopy, WALL: wall}
"""Of random scenes, by kind."""
_SCENES, _VIEWS = 200, 6
_CHUNK = 16
_MOST_MISSED, _MOST_TOOL, _MOST_UNLIT = 0.02, 0.6, 0.2


def render_buffers(seed: int, index: int, width: int, height: int, *, kind: int | None = None) -> Buffers:
    """Return frame `index` of the set `seed`; the same arguments give the same bytes.

    `kind` overrides the kind of scene that the set's fixed shares give to this index.
    """
    rng = np.random.default_rng((seed, index))
    wanted = _kind_of(index, seed) if kind is None else kind
    for _ in range(_SCENES):
        scene = MAKERS[wanted](rng)
        for _ in range(_VIEWS):
            view = random_view(scene, rng, width, height)
            buffers = None if view is None else _rendered(scene, view, rng)
            if buffers is not None:
                return buffers
    raise InputError(f"rendering frame {index} of set {seed}: no scene of kind {wanted} gave a view; widen the scenes.")


def counted(what: str, every: int, say: Callable[[str], None]) -> Callable[[int, int], None]:
    """Return a progress that says every so manieth scene, and the last."""

    def progress(done: int, count: int) -> None:
        if done == count or done // every != (done - _CHUNK) // every:
            say(f"{what}: {done} of {count} rendered")

    return progress


def _kind_of(index: int, seed: int) -> int:
    """Return the kind of scene `index` of a set: the shares are fixed, the order is shuffled in blocks of 100."""
    deck = np.repeat([kind for kind, _ in _SHARES], [round(100 * share) for _, share in _SHARES])
    return int(np.random.default_rng((seed, index // 100, 77)).permutation(deck)[index % 100])


def _rendered(scene: Scene, view: SceneView, rng: np.random.Generator) -> Buffers | None:
    """All buffers of a view, or None where the view turns out to be bad."""
    scene = scene.with_tools(random_tools(scene, view, rng))
    arrays = scene.arrays()
    rays = camera_rays(view.camera)
    ahead = rotated(rays, view.rotation)
    distances = march_rays(arrays, view.eye, ahead, view.step, FAR)
    scale = _scale_mm(scene.kind, distances, rng)
    if scale is None:
        return None
    normal, part = np.zeros_like(rays), np.zeros(distances.shape, np.uint8)
    pixel = 1.0 / float(view.camera[1])
    surface(arrays, view.eye, ahead, distances, pixel, normal, part)
    if (part == INSTRUMENT).mean() > _MOST_TOOL:
        return None
    noise = np.zeros((*distances.shape, len(NOISE_PERIODS)))
    periods = np.array([(period, 0 < n < 7) for n, period in enumerate(NOISE_PERIODS)])
    noise_channels(view.eye, ahead, distances, scene.seed, periods, pixel, noise)
    normal = rotated(normal, view.rotation.T)
    lamps_mm = _random_lamps(rng, scale * float(np.nanmedian(distances)))
    lit = _lit(arrays, view, (rays, distances, normal), lamps_mm / scale, rng)
    if unlit_share(scale * distances[..., None] * rays, normal, lit, lamps_mm) > _MOST_UNLIT:
        return None
    return Buffers(
        log_distance=np.log(scale * distances).astype(np.float32),
        normal=normal.astype(np.float32),
        noise=np.clip(noise, -1, 1).astype(np.float32),
        part=part,
        lit=lit,
        lamps_mm=lamps_mm.astype(np.float32),
        camera=view.camera,
        scale_mm=scale,
        kind=scene.kind,
    )


def _scale_mm(kind: int, distances: np.ndarray, rng: np.random.Generator) -> float | None:
    """Draw mm per scene unit, so that medians spread and every distance is in range; None where none fits."""
    if np.isnan(distances).mean() > _MOST_MISSED or not found_well(distances):
        return None
    median = float(np.nanmedian(distances))
    low, high = _MEDIANS_MM[kind]
    least = max(low / median, _NEAREST_MM / float(np.nanmin(distances)))
    most = min(high / median, _FARTHEST_MM / float(np.nanmax(distances)))
    if least > most:
        return None
    # The draw comes first, the limits then: the spread stays log-uniform where the limits let it.
    return min(max(log_uniform(rng, low, high) / median, least * 1.0001), most * 0.9999)


def _random_lamps(rng: np.random.Generator, median_mm: float) -> np.ndarray:
    """One or two lamps (2, 3), mm, camera axes: up to 6 mm beside the lens, mostly near; NaN where there is none."""
    lamps = np.full((2, 3), np.nan)
    reach = min(6.0, 0.15 * median_mm)
    first = rng.uniform(0, 2 * np.pi)
    for n in range(2 if rng.random() < 0.55 else 1):
        angle = first + n * (np.pi + rng.normal(0, 0.5))
        offset = reach * rng.random() ** 1.7
        lamps[n] = offset * np.cos(angle), offset * np.sin(angle), 0.3 * offset * rng.normal()
    return lamps


def _lit(
    arrays: tuple[np.ndarray, ...],
    view: SceneView,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    lamps: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Share (H, W, 2) float32 of each lamp's light that arrives; lamps (2, 3) in scene units."""
    soft = log_uniform(rng, 15.0, 300.0)
    place = (view.eye, np.ascontiguousarray(view.rotation), view.camera.astype(np.float64))
    lit = np.zeros((*seen[1].shape, 2))
    for n in range(2):
        if np.isfinite(lamps[n]).all():
            out = np.zeros(seen[1].shape)
            shade_shadows(arrays, place, seen, np.ascontiguousarray(lamps[n]), view.step, soft, out)
            lit[..., n] = out
    return np.clip(lit, 0, 1).astype(np.float32)


def unlit_share(points_mm: np.ndarray, normal: np.ndarray, lit: np.ndarray, lamps_mm: np.ndarray) -> float:
    """Share of the surface that no lamp reaches: it is large only where a lamp is buried in tissue close by."""
    most = np.zeros(points_mm.shape[:2])
    for n in np.flatnonzero(np.isfinite(lamps_mm).all(1)):
        towards = lamps_mm[n] - points_mm
        cosine = (towards * normal).sum(-1) / np.linalg.norm(towards, axis=-1)
        most = np.fmax(most, lit[..., n] * cosine)
    return float((most < 0.01).mean())


def _render_chunk(folder: str, indices: list[int], seed: int, size: tuple[int, int]) -> list[int]:
    """Render some frames into a store that exists; runs in a worker."""
    store = open_store(folder, mode="r+")
    for index in indices:
        store.put(index, render_buffers(seed, index, size[1], size[0]))
    return indices


def render_store(
    folder: Path | str,
    count: int,
    size: tuple[int, int],
    seed: int,
    *,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render frames 0..count-1 of the set `seed` at size (height, width) into a store.

    Frames that the store holds already are kept, so an interrupted rendering goes on where it stopped. `workers`
    processes of one thread each (0: in this process). `progress(done, count)` is called after each 16 frames.
    Raises InputError where the folder holds a store of another size.
    """
    store = create_store(Path(folder), count, size)
    todo = np.flatnonzero(~store.done).tolist()
    chunks = [todo[n : n + _CHUNK] for n in range(0, len(todo), _CHUNK)]
    finished = count - len(todo)
    for indices in _chunks_done(str(folder), chunks, seed, size, workers):
        finished += len(indices)
        if progress is not None:
            progress(finished, count)


def _end_with_parent() -> None:
    """Make this worker end when the process that started it is killed; else it would wait for work for ever."""
    parent = parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _chunks_done(
    folder: str, chunks: list[list[int]], seed: int, size: tuple[int, int], workers: int
) -> Iterator[list[int]]:
    if workers == 0:
        yield from (_render_chunk(folder, chunk, seed, size) for chunk in chunks)
        return
    # Spawned, not forked: the caller may hold threads.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_end_with_parent) as pool:
        waiting = [pool.submit(_render_chunk, folder, chunk, seed, size) for chunk in chunks]
        for done in as_completed(waiting):
            yield done.result()


def main(arguments: list[str] | None = None) -> None:
    """Command line: `python -m training.render --out FOLDER --count N`."""
    parser = argparse.ArgumentParser(prog="training.render", description="Render frames to train the depth network on.")
    parser.add_argument("--out", required=True, help="folder of the store; an unfinished one is gone on with")
    parser.add_argument("--count", type=int, required=True, help="number of frames")
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes; 0 renders in this one")
    given = parser.parse_args(arguments)
    begin = time.perf_counter()

    def report(done: int, count: int) -> None:
        sys.stdout.write(f"{done}/{count} frames, {time.perf_counter() - begin:.0f} s\n")
        sys.stdout.flush()

    size = (given.height, given.width)
    render_store(given.out, given.count, size, given.seed, workers=given.workers, progress=report)


if __name__ == "__main__":
    main()
