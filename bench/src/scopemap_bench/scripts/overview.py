"""What `scopemap run` reaches on real clips and phantoms: the overview of BENCHMARK.md.

    python -m scopemap_bench.scripts.overview --data FOLDER [--out FOLDER] [--only NAME ...] [--repeat N]

A row is a run of the command line by a preset (`realtime` on five clips), measured by `scopemap evaluate` after a
Sim(3) alignment. Frames per second are those of the whole command, the median of `--repeat`; the time of a frame in DIS
flows of 320x256 px, measured before each run, compares machines.
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
from scopemap_bench.speed import calibrations_ms

PHANTOMS = {
    "colon phantom": ("--scene", "colon", "--frames", 120, "--seed", 11),
    "laparoscopy phantom": ("--scene", "laparoscopy", "--frames", 120, "--seed", 12),
    "tube phantom, no texture": ("--scene", "tube", "--frames", 120, "--seed", 13),
    "colon phantom, breathing": ("--scene", "colon", "--frames", 120, "--seed", 14, "--deform"),
}
CONSISTENCY = "true depth / depth in the path's scale: median / least / most"
SPEED = ("frames per s", "DIS flows a frame")
REALTIME = ("C3VD cecum_t1_a", "colon phantom", "laparoscopy phantom", "colonoscopy video", "laparoscopy video")


@dataclass(frozen=True)
class Clip:
    """One row: name, input, whether that has a truth, further arguments of `scopemap run`, folder of true depth."""

    name: str
    source: Path
    has_truth: bool = True
    arguments: tuple[str, ...] = ()
    true_depth: Path | None = None

    def run_folder(self, out: Path, preset: str = "default") -> Path:
        """Return the folder of its run by a preset."""
        return out / preset / re.sub(r"\W+", "-", self.name)

    def truth(self, folder: Path) -> Path:
        """Return the folder with the truth: the input, or links to it and to its true depth in a new folder."""
        if self.true_depth is None:
            return self.source
        folder.mkdir(parents=True, exist_ok=True)
        links = {file.name: file for file in self.source.iterdir()}
        links |= {f"{int(file.name[:4])}_depth.png": file for file in self.true_depth.glob("*_depth.png")}
        for name, file in links.items():
            if not (folder / name).exists():
                (folder / name).symlink_to(file.resolve())
        return folder


def clips(data: Path, out: Path) -> dict[str, Clip]:
    """Return all clips by name; phantoms are to be in `out` / phantoms (`drawn`)."""
    c3vd, video = data / "endoscopy" / "c3vd", data / "endoscopy" / "video"
    cecum, trans, kitchen = c3vd / "cecum_t1_a", c3vd / "trans_t1_a", data / "rgbd" / "7scenes_kitchen_100f"
    disparity = ("--depth", f"files:{cecum}_depth_anything", "--near-far", "13.5:100")
    room = ("fusion.voxel_mm=10", "fusion.truncation_mm=40", "fusion.max_depth_mm=4000")
    room_settings = tuple(word for setting in room for word in ("--set", setting))
    found = [
        Clip("C3VD cecum_t1_a", cecum, true_depth=c3vd / "cecum_t1_a_true_depth"),
        Clip("C3VD cecum_t1_a, Depth Anything's disparity", cecum, True, disparity, c3vd / "cecum_t1_a_true_depth"),
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


def measure(clip: Clip, preset: str, out: Path, repeat: int) -> None:
    """Run a clip `repeat` times and print its row."""
    run, elapsed_s, flows_ms = clip.run_folder(out, preset), [], []
    for _ in range(repeat):
        flows_ms += calibrations_ms()
        shutil.rmtree(run, ignore_errors=True)
        started = time.perf_counter()
        measuring.scopemap("run", clip.source, "--out", run, "--preset", preset, "--quiet", *clip.arguments)
        elapsed_s.append(time.perf_counter() - started)
    facts, figures = measuring.provenance(run), {}
    if clip.has_truth:
        truth = clip.truth(out / "truth" / run.name)
        figures = measuring.evaluated(run, "--truth", truth, "--align", "sim3", "--depth", "median")
    frames, elapsed = facts["frames"], statistics.median(elapsed_s)
    rpe = [measuring.cell(figures, ".3f", name) for name in ("rpe_10_mm", "rpe_10_deg")]
    measuring.print_row(
        clip.name if preset == "default" else f"{clip.name}, `{preset}`",
        f"{facts['tracked']} of {frames}",
        measuring.submaps(run),
        measuring.cell(figures, ".3f", "ate_rmse_mm"),
        measuring.rotation(figures),
        " / ".join(filter(None, rpe)),
        measuring.cell(depth := figures.get("depth", {}), ".3f", "abs_rel"),
        measuring.cell(depth.get("metric_consistency", {}), ".3f", "median", "least", "most"),
        measuring.cell(figures, ".2f", "mesh_accuracy_mm"),
        f"{frames / elapsed:.1f}",
        f"{1e3 * elapsed / frames / statistics.median(flows_ms):.1f}",
    )


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=["*"], help="names of clips; * is any text")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each clip")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        heads = ("clip", "frames in the result", "submaps", "ATE RMSE mm", "rotation mean / max deg")
        measuring.print_head(*heads, "RPE 10 mm / deg", "depth AbsRel", CONSISTENCY, "mesh to truth mm", *SPEED)
        known = clips(options.data, out)
        wanted = [name for name in known if any(fnmatch(name, pattern) for pattern in options.only)]
        rows = [(name, "default") for name in wanted] + [(name, "realtime") for name in wanted if name in REALTIME]
        for name, preset in rows:
            measure(drawn(known[name]), preset, out, options.repeat)


if __name__ == "__main__":
    main()
