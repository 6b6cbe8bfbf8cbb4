"""What `scopemap run` reaches on real clips and phantoms: the overview of BENCHMARK.md and its picture of the speed.

    python -m scopemap_bench.scripts.overview --data FOLDER [--out FOLDER] [--picture FILE] [--only NAME ...]
            [--presets NAME ...] [--repeat N]

A row is a run of the command line by a preset (`realtime` on five clips), measured by `scopemap evaluate` after a
Sim(3) alignment. Frames per second are those of the whole command, the median of `--repeat`.
"""

from __future__ import annotations

import re
import shutil
import statistics
import time
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from scopemap_bench.scripts import measuring

PHANTOMS = {
    "colon phantom": ("--scene", "colon", "--frames", 120, "--seed", 11),
    "laparoscopy phantom": ("--scene", "laparoscopy", "--frames", 120, "--seed", 12),
    "tube phantom, no texture": ("--scene", "tube", "--frames", 120, "--seed", 13),
    "colon phantom, breathing": ("--scene", "colon", "--frames", 120, "--seed", 14, "--deform"),
}
REALTIME = ("C3VD cecum_t1_a", "colon phantom", "laparoscopy phantom", "colonoscopy video", "laparoscopy video")
NO_TRUE_DEPTH = ("C3VD cecum_t1_a", "C3VD cecum_t1_a, Depth Anything's disparity")
STAGES = ("focal length", "read", "preprocess", "match", "track", "back end", "fuse")


@dataclass(frozen=True)
class Clip:
    """One row: its name, the input, whether it has a truth, and further arguments of `scopemap run`."""

    name: str
    source: Path
    has_truth: bool = True
    arguments: tuple[str, ...] = ()

    def run_folder(self, out: Path, preset: str = "default") -> Path:
        """Return the folder of its run by a preset."""
        return out / preset / re.sub(r"\W+", "-", self.name)


def clips(data: Path, out: Path) -> dict[str, Clip]:
    """Return all clips by name; phantoms are to be in `out` / phantoms (`drawn`)."""
    c3vd, video = data / "endoscopy" / "c3vd", data / "endoscopy" / "video"
    cecum, trans, kitchen = c3vd / "cecum_t1_a", c3vd / "trans_t1_a", data / "rgbd" / "7scenes_kitchen_100f"
    disparity = ("--depth", f"files:{cecum}_depth_anything", "--near-far", "13.5:100")
    room = ("fusion.voxel_mm=10", "fusion.truncation_mm=40", "fusion.max_depth_mm=4000")
    room_settings = tuple(word for setting in room for word in ("--set", setting))
    found = [
        Clip("C3VD cecum_t1_a", cecum),
        Clip("C3VD cecum_t1_a, Depth Anything's disparity", cecum, arguments=disparity),
        Clip("C3VD trans_t1_a (10 frames), true depth", trans, arguments=("--depth", f"files:{trans}")),
        Clip("7-Scenes kitchen, measured depth", kitchen, arguments=("--depth", f"files:{kitchen}", *room_settings)),
        *(Clip(name, out / "phantoms" / re.sub(r"\W+", "-", name)) for name in PHANTOMS),
        Clip("colonoscopy video", video / "colonoscopy_nflba_03.mp4", has_truth=False),
        Clip("laparoscopy video", video / "laparoscopy_rvim.mp4", has_truth=False),
    ]
    return {clip.name: clip for clip in found}


def drawn(clip: Clip) -> Clip:
    """Return the clip, after its phantom was rendered where it is missing."""
    if clip.name in PHANTOMS:
        measuring.phantom(clip.source, *PHANTOMS[clip.name])
    return clip


def measure(clip: Clip, preset: str, out: Path, repeat: int) -> dict[str, float]:
    """Run a clip `repeat` times, print its row, and return the seconds per frame of each stage."""
    run, elapsed_s = clip.run_folder(out, preset), []
    for _ in range(repeat):
        shutil.rmtree(run, ignore_errors=True)
        started = time.perf_counter()
        measuring.scopemap("run", clip.source, "--out", run, "--preset", preset, "--quiet", *clip.arguments)
        elapsed_s.append(time.perf_counter() - started)
    facts, figures = measuring.provenance(run), {}
    if clip.has_truth:
        against = ("--truth", clip.source, "--align", "sim3")
        # A clip without true depth refuses to measure it.
        figures = measuring.evaluated(run, *against, *(() if clip.name in NO_TRUE_DEPTH else ("--depth", "median")))
    frames = facts["frames"]
    rpe = [measuring.cell(figures, ".3f", name) for name in ("rpe_10_mm", "rpe_10_deg")]
    measuring.print_row(
        clip.name if preset == "default" else f"{clip.name}, `{preset}`",
        f"{facts['tracked']} of {frames}",
        measuring.submaps(run),
        measuring.cell(figures, ".3f", "ate_rmse_mm"),
        measuring.rotation(figures),
        " / ".join(filter(None, rpe)),
        measuring.cell(figures.get("depth", {}), ".3f", "abs_rel"),
        measuring.cell(figures, ".2f", "mesh_accuracy_mm"),
        f"{frames / statistics.median(elapsed_s):.1f}",
    )
    return {stage: facts["seconds"].get(stage, 0.0) / frames for stage in STAGES}


def draw_speed(stages: dict[str, dict[str, float]], file: Path) -> None:
    """Draw the time per frame of each stage for each clip as a PNG; the first stages overlap with tracking."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.5 * len(stages) + 1.4), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    names, left = list(stages), [0.0] * len(stages)
    for stage in STAGES:
        width = [1e3 * stages[name][stage] for name in names]
        axes.barh(names, width, left=left, label=stage)
        left = [a + b for a, b in zip(left, width, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel('ms per frame, one thread; stages up to "track" run side by side')
    axes.legend(ncols=len(STAGES), loc="lower center", bbox_to_anchor=(0.35, 1.0), frameon=False, fontsize="small")
    figure.savefig(file)


def main() -> None:
    """Run, measure, print, draw."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--picture", type=Path, help="draw the time of each stage into this PNG")
    parser.add_argument("--only", nargs="+", default=["*"], help="names of clips; * is any text")
    parser.add_argument("--presets", nargs="+", default=["default", "realtime"])
    parser.add_argument("--repeat", type=int, default=1, help="runs of each clip")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        stages = {}
        heads = ("clip", "frames in the result", "submaps", "ATE RMSE mm", "rotation mean / max deg")
        measuring.print_head(*heads, "RPE 10 mm / deg", "depth AbsRel", "mesh to truth mm", "frames per s")
        for preset in options.presets:
            for name, clip in clips(options.data, out).items():
                wanted = any(fnmatch(name, pattern) for pattern in options.only)
                if wanted and (preset != "realtime" or name in REALTIME):
                    stages[f"{name}, {preset}"] = measure(drawn(clip), preset, out, options.repeat)
        if options.picture:
            draw_speed(stages, options.picture)


if __name__ == "__main__":
    main()
