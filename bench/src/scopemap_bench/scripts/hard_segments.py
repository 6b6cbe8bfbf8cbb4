"""What becomes of frames that show nothing, of places seen again, and of a wall without texture; as Markdown.

    python -m scopemap_bench.scripts.hard_segments [--only veiled|loop|cut|bare]

Phantoms drawn by our own code, scopenet, DIS flow, no surface. veiled: 200 frames, of which 10 are black, 10 blurred
and 10 full of smoke; errors of the clear frames alone, in the same run without that and in this one. loop: 601 frames
that end where they began. cut: 401 such frames without numbers 80 to 179, as where a recording was stopped on the way
out. bare: a straight tube without texture.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scopemap import Reconstruction, open_sequence, reconstruct
from scopemap.config import Config
from scopemap.evaluation.poses import match, pose_report
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import Trajectory
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom
from scopemap_bench.scripts.accuracy import NO_SURFACE, TRACKED

EVENTS = "black:60-69,blur:95-104,smoke:130-139"
CUT = range(80, 180)
BAD = [*range(60, 70), *range(95, 105), *range(130, 140)]
VARIANTS: dict[str, dict[str, Any]] = {"default": {}, "no back end": TRACKED}


def run(source: Path, settings: dict[str, Any]) -> Reconstruction:
    """Reconstruct a phantom with scopenet."""
    return reconstruct(open_sequence(source), Config.load(settings=NO_SURFACE | settings))


def without(trajectory: Trajectory, frames: list[int]) -> Trajectory:
    """Return a trajectory in which some frames are lost."""
    status = trajectory.status.copy()
    status[frames] = "lost"
    return Trajectory(trajectory.indices, trajectory.times_s, trajectory.T_world_camera, status)


def ate_mm(result: Reconstruction, source: Path) -> float:
    """Error of the frames that are clear in both runs, aligned by a similarity."""
    return pose_report(match(without(result.trajectory, BAD), read_trajectory(source), "sim3"))["ate_rmse_mm"]


def veiled(folder: Path) -> list[str]:
    """Rows of the first table."""
    rows = ["| phantom | bad frames lost | clear frames until tracked again | ATE mm, undisturbed | ATE mm | ratio |"]
    rows.append("|---|---|---|---|---|---|")
    for scene in ("colon", "laparoscopy"):
        clean, spoilt = folder / f"{scene}_clean", folder / f"{scene}_veiled"
        write_phantom(PhantomSpec(scene=scene, frames=200, seed=11), clean)
        write_phantom(PhantomSpec(scene=scene, frames=200, seed=11, events=parse_events(EVENTS)), spoilt)
        for name, changes in VARIANTS.items():
            before, after = run(clean, changes), run(spoilt, changes)
            lost = ~after.frames.tracked
            after_each = [lost[end + 1 :] for end in (69, 104, 139)]
            waits = ["never" if still.all() else int(np.argmin(still)) for still in after_each]
            one, other = ate_mm(before, clean), ate_mm(after, spoilt)
            rows.append(
                f"| {scene}, {name} | {lost[BAD].sum()} of {len(BAD)} | {', '.join(map(str, waits))} | {one:.3f} "
                f"| {other:.3f} | {other / one:.2f} |"
            )
    return rows


def loop(folder: Path) -> list[str]:
    """Rows of the second table."""
    rows = [
        "| phantom | loops closed | end from start mm / deg | ATE mm | rotation mean / max deg |",
        "|---|---|---|---|---|",
    ]
    for scene in ("colon", "laparoscopy"):
        source = folder / f"{scene}_loop"
        write_phantom(PhantomSpec(scene=scene, frames=601, seed=12, loop=True), source)
        for name, changes in {"no loops": {"mapping.min_loop_inliers": 0}, **VARIANTS}.items():
            result = run(source, changes)
            poses = result.trajectory.T_world_camera
            off = inverse(poses[0]) @ poses[-1]
            report = pose_report(match(result.trajectory, read_trajectory(source), "sim3"))
            adjusted = [one for one in result.provenance["notices"] if one["code"] == "mapping-adjusted"]
            closed = adjusted[0]["values"]["loops"] if adjusted else 0
            rows.append(
                f"| {scene}, {name} | {closed} | {np.linalg.norm(off[:3, 3]):.2f} / "
                f"{np.degrees(rotation_angle_rad(off[:3, :3])):.2f} | {report['ate_rmse_mm']:.3f} "
                f"| {report['rotation_unaligned_mean_deg']:.2f} / {report['rotation_unaligned_max_deg']:.2f} |"
            )
    return rows


def cut(folder: Path) -> list[str]:
    """Rows of the third table."""
    rows = [
        "| phantom | maps | frames kept | ATE mm | rotation mean / max deg | scale after the cut over that before |",
        "|---|---|---|---|---|---|",
    ]
    for scene in ("colon", "laparoscopy"):
        whole, source = folder / f"{scene}_whole", folder / f"{scene}_cut"
        write_phantom(PhantomSpec(scene=scene, frames=401, seed=12, loop=True), whole)
        keep(whole, source, [n for n in range(401) if n not in CUT])
        for name, changes in {"no loops": {"mapping.min_loop_inliers": 0}, **VARIANTS}.items():
            result = run(source, changes)
            trajectory, truth = result.trajectory, read_trajectory(source)
            report = pose_report(match(trajectory, truth, "sim3"))
            tracked = result.frames["map"][result.frames.tracked].tolist()
            parts = [without(trajectory, [n for n in range(301) if (n < CUT[0]) != early]) for early in (True, False)]
            scales = [match(part, truth, "sim3").similarity.scale if part.tracked.any() else np.nan for part in parts]
            rows.append(
                f"| {scene}, {name} | {len(set(tracked))} | {len(tracked)} of {len(result.frames)} "
                f"| {report['ate_rmse_mm']:.3f} "
                f"| {report['rotation_unaligned_mean_deg']:.2f} / {report['rotation_unaligned_max_deg']:.2f} "
                f"| {scales[0] / scales[1]:.2f} |".replace("nan", "")
            )
    return rows


def keep(source: Path, target: Path, frames: list[int]) -> None:
    """Copy some frames of a phantom, numbered anew."""
    target.mkdir()
    for number, frame in enumerate(frames):
        for file in source.glob(f"{frame:04d}_*"):
            shutil.copy(file, target / f"{number:04d}{file.name[4:]}")
    poses = (source / "pose.txt").read_text().splitlines()
    (target / "pose.txt").write_text("\n".join(poses[frame] for frame in frames) + "\n")
    shutil.copy(source / "camera.yaml", target)


def bare(folder: Path) -> list[str]:
    """Rows of the last table."""
    source = folder / "tube"
    write_phantom(PhantomSpec(scene="tube", frames=120, seed=13), source)
    result = run(source, {})
    weak = sum("weakly constrained" in reason for reason in result.frames["reason"])
    return [
        "| phantom | frames | said to be weakly constrained | lost in all |",
        "|---|---|---|---|",
        f"| straight tube without texture | {len(result.frames)} | {weak} | {len(result.lost)} |",
    ]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables: dict[str, Callable[[Path], list[str]]] = {"veiled": veiled, "loop": loop, "cut": cut, "bare": bare}
    parser.add_argument("--only", choices=tables)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for name, table in tables.items():
            if options.only in (None, name):
                print("\n".join(table(Path(scratch))), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
