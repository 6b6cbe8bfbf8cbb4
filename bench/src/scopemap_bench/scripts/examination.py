"""A whole examination as one video, of which it is known what each frame shows and where the camera is.

    python -m scopemap_bench.scripts.examination [--frames 20000] [--walk 150] [--out FOLDER] [--seeds 51 52 53 54]

The first frames (--walk) of phantom colons, one a seed, are walked there and back, one colon after the other, again and
again, so that frames repeat. Between and over the walks lies what an examination holds: the room before and after it, a
covered lamp, the wall touched, water, smoke, blur, a camera at rest, cuts. First table: what became of the frames, by
what they show. Second: submaps of 3 s and more: the colon that most of their frames are of, frames of others (joined
wrongly), ATE after a Sim(3) alignment, and that one's scale. Then segments found, frames per second, memory, time per
frame in the quarters.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np

from scopemap.engine.geometry.align import align_trajectories
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.phantom.shading import develop, disturb
from scopemap_bench.scripts import measuring

LENGTH = 150
FPS = 30
SIZE = (320, 256)
CLEAR = "clear view"
ROOM = "room"
BETWEEN = ("covered lamp", "contact", "cut", "at rest", "water", "blur", "smoke")
"""What follows a walk, in turn; of the last three the walk goes on behind."""
SHORT = 45  # frames of what lies between, in turn
LONG = 150
_DISTURBED = {"water": "fluid", "blur": "blur", "smoke": "smoke"}
_GAMMA = 2.4
_NOISE = 0.004
_USABLE_S = 3.0
_STEADY = 10  # frames into a row of skipped ones, from which their time counts


class Shown(NamedTuple):
    """What a frame shows: its kind, the place of its colon in the list, and the number of that one's picture."""

    kind: str
    colon: int
    picture: int


def schedule(count: int, colons: int, length: int) -> list[Shown]:
    """Return what each of `count` frames shows, with walks there and back over so many pictures."""
    walk, shown = measuring.there_and_back(2 * length - 2, length), [Shown(ROOM, 0, 0)] * (count // 40)
    for turn, kind in enumerate(cycle(BETWEEN)):
        colon, rest = turn % colons, LONG if turn % 2 else SHORT
        if len(shown) >= count - count // 40:
            return shown[: count - count // 40] + [Shown(ROOM, 0, 0)] * (count // 40)
        shown += [Shown(CLEAR, colon, picture) for picture in walk]
        if kind in _DISTURBED:
            shown += [Shown(kind, colon, picture) for picture in measuring.there_and_back(rest, length)]
        elif kind != "cut":
            shown += [Shown(kind, colon, walk[-1])] * rest
    raise AssertionError


def picture_of(shown: Shown, sources: list[list[np.ndarray]], number: int) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of frame `number`."""
    rng, (width, height) = np.random.default_rng(number), SIZE
    if shown.kind == CLEAR:
        return sources[shown.colon][shown.picture]
    across, down = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    match shown.kind:
        case "room":
            drape = np.random.default_rng(5).uniform(0.1, 0.7, (40, 90, 3)).astype(np.float32)
            place = (5 * number) % 600
            linear = cv2.resize(drape, (1000, 450))[100 : 100 + height, place : place + width]
        case "covered lamp":
            linear = np.zeros((height, width, 3), np.float32)
        case "contact":
            bright = 1 - 0.4 * np.hypot(across, down)[..., None]
            linear = (bright * np.array([0.4, 0.03, 0.02])).astype(np.float32)
        case _:
            linear = (sources[shown.colon][shown.picture] / np.float32(255)) ** np.float32(_GAMMA)
            if shown.kind in _DISTURBED:
                linear = disturb(linear, {_DISTURBED[shown.kind]}, rng, number)  # type: ignore[arg-type]
    return develop(linear, _NOISE, rng)


def rgb_of(file: Path) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 in a file."""
    picture = cv2.imread(str(file))
    assert picture is not None
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def write_video(file: Path, plan: list[Shown], colons: list[Path]) -> None:
    """Write the frames as H.264, unless they are there."""
    if file.is_file():
        return
    sources = [[rgb_of(name) for name in sorted(colon.glob("*_color.png"))] for colon in colons]
    part = file.with_suffix(".part.mp4")
    with av.open(str(part), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "18", "preset": "veryfast"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for number, shown in enumerate(plan):
            picture = picture_of(shown, sources, number)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    part.replace(file)


def run_watched(video: Path, camera: Path, out: Path) -> None:
    """Run the video unless its result is there, and note seconds and peak memory beside it."""
    note = out.with_suffix(".json")
    if note.is_file():
        return
    words = ("run", video, "--camera", camera, "--out", out, "--quiet")
    process = subprocess.Popen(measuring.command_line(*words))
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"the run of {video} failed")
    note.write_text(json.dumps({"peak_mb": used.ru_maxrss * 1024 / 1e6}))


def rows_where(condition: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield first and last of each row of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], condition, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)


def print_kinds(plan: list[Shown], frames: FrameTable, skipped: np.ndarray) -> None:
    """Print what became of the frames, by what they show."""
    kinds, submap = np.array([shown.kind for shown in plan])[frames["index"]], frames.submap
    measuring.print_head("shows", "frames", "in a submap", "lost after a search", "lost unseen", "left out: at rest")
    for kind in dict.fromkeys(kinds.tolist()):
        of, left_out = kinds == kind, frames["status"] == "skipped"
        lost = frames.lost & ~skipped
        counts = [int((of & some).sum()) for some in (submap >= 0, lost, skipped, left_out)]
        measuring.print_row(kind, int(of.sum()), *counts)


def print_submaps(plan: list[Shown], run: Result, poses: list[np.ndarray]) -> None:
    """Print the submaps of 3 s and more against the truth."""
    measuring.print_head("submap", "frames", "mostly of", "frames of anything else", "ATE mm", "true size / its own")
    small = 0
    for number, submap in enumerate(run.submaps):
        own = submap.frames.only(submap.frames.tracked)
        shown = [plan[index] for index in own["index"].tolist()]
        of = [ROOM if one.kind == ROOM else one.colon for one in shown]
        most = max(set(of), key=of.count)
        if len(of) < _USABLE_S * FPS:
            small += 1
            continue
        ate = size = ""
        if most != ROOM:
            inside = np.array([one == most for one in of])
            truth = np.stack([poses[one.colon][one.picture] for one in shown])[inside]
            moved, S_true_own = align_trajectories(own["T_world_camera"][inside], truth, "sim3")
            ate = f"{np.sqrt(((moved - truth)[:, :3, 3] ** 2).sum(1).mean()):.2f}"
            size = f"{S_true_own.scale:.2f}"
        measuring.print_row(number, len(of), most, len(of) - of.count(most), ate, size)
    print(f"\n{small} further submaps of less than {_USABLE_S:g} s")


def print_cost(plan: list[Shown], run: Result, skipped: np.ndarray, peak_mb: float) -> None:
    """Print segments found, speed, memory, and time per frame in the quarters."""
    frames, clear = run.frames, np.array([shown.kind == CLEAR for shown in plan])
    tracked = frames.submap >= 0
    segments = [tracked[first : last + 1].mean() for first, last in rows_where(clear[frames["index"]])]
    ms = np.array([run.measures.get(index, (np.nan, np.nan))[1] for index in frames["index"].tolist()])
    steady = np.zeros(len(frames), bool)
    for first, last in rows_where(skipped):
        steady[first + _STEADY : last + 1] = True
    print(f"\nclear segments: {len(segments)}, least share tracked {min(segments):.0%}, mean {np.mean(segments):.1%}")
    quarters = [np.nanmean(ms[part][tracked[part]]) for part in np.array_split(np.arange(len(frames)), 4)]
    fps = [1000 / np.nanmean(ms[some]) for some in (steady, tracked)]
    print(f"frames/s: {fps[0]:.0f} lost unseen, {fps[1]:.1f} tracked (ratio {fps[0] / fps[1]:.0f})")
    print("ms a tracked frame, by quarter: " + " ".join(f"{value:.0f}" for value in quarters))
    print(f"peak memory {peak_mb:.0f} MB; seconds {json.dumps(run.provenance['seconds'])}")


def main() -> None:
    """Draw, run, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--walk", type=int, default=LENGTH, help="pictures of a colon that are walked there and back")
    parser.add_argument("--seeds", type=int, nargs="+", default=[51, 52, 53, 54], help="of the colons")
    given = parser.parse_args()
    with measuring.folder_or_scratch(given.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        words = ("--frames", LENGTH, "--size", f"{SIZE[0]}x{SIZE[1]}")
        colons = [measuring.phantom(folder / f"colon-{seed}", *words, "--seed", seed) for seed in given.seeds]
        plan, video = schedule(given.frames, len(colons), given.walk), folder / f"examination-{given.frames}.mp4"
        write_video(video, plan, colons)
        out = folder / f"run-{given.frames}"
        run_watched(video, colons[0] / "camera.yaml", out)
        run = Result(out).checked()
        depths = {int(file.stem) for file in (out / "depth").glob("*.png")}
        unseen = np.array([index not in depths for index in run.frames["index"].tolist()]) & run.frames.lost
        print_kinds(plan, run.frames, unseen)
        print()
        print_submaps(plan, run, [read_trajectory(colon).T_world_camera for colon in colons])
        print_cost(plan, run, unseen, json.loads(out.with_suffix(".json").read_text())["peak_mb"])


if __name__ == "__main__":
    main()
