"""Frames of a video located in the map of another one, by `scopemap locate`, with the truth where there is one.

    python -m scopemap_bench.scripts.locating --data FOLDER [--out FOLDER]

The map is made of the first half of a video, and the frames of its second half are located in it; then those of videos
of other places, none of which is to be found. Position: distance of the camera's centre from its true place, after the
Sim(3) of the map's own path to the truth; rotation after that alignment.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3
from scopemap.evaluation.poses import match
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.scripts import measuring

PHANTOM_FRAMES = 150


def errors(run: Path, source: Path, table: Path, video: Path | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the located frames, mm and degrees, by the truth that comes with the map's source.

    video : whose frames they are, with a truth of the same world; None: the map's source.
    """
    similarity = match(read_trajectory(run), read_trajectory(source), "sim3").similarity
    truth = read_trajectory(video or source)
    true_pose = dict(zip(truth.indices.tolist(), truth.T_world_camera, strict=True))
    mm, deg = [], []
    with table.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["status"] == "found" and row["map"] == "0":
                R = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")]).as_matrix()
                pose = se3(R, np.array([float(row[name]) for name in ("tx", "ty", "tz")]))
                T = inverse(true_pose[int(row["index"])]) @ similarity.transform_poses(pose[None])[0]
                mm.append(float(np.linalg.norm(T[:3, 3])))
                deg.append(float(np.degrees(rotation_angle_rad(T[:3, :3]))))
    return np.array(mm), np.array(deg)


def print_located(of: str, run: Path, name: str, video: Path, frames: str, out: Path, *, truth: bool) -> None:
    """Locate frames of a video in a map, and print a row."""
    measuring.scopemap("locate", run, video, "--frames", frames, "--out", out, "--overwrite", "--quiet")
    with out.open(encoding="utf-8") as file:
        found = [row["status"] == "found" for row in csv.DictReader(file)]
    mm, deg = errors(run, video, out) if truth else (np.zeros(0), np.zeros(0))
    cells = [" / ".join(f"{np.percentile(e, p):.2f}" for p in (50, 90)) if len(e) else "" for e in (mm, deg)]
    measuring.print_row(of, name, f"{sum(found)} of {len(found)}", *cells)


def main() -> None:
    """Print the table."""
    options = measuring.options_of(__doc__, data=True, out=True).parse_args()
    c3vd = options.data / "endoscopy" / "c3vd"
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        colon = measuring.phantom(folder / "colon", "--frames", PHANTOM_FRAMES, "--seed", 61)
        cavity = measuring.phantom(
            folder / "cavity", "--scene", "laparoscopy", "--frames", PHANTOM_FRAMES, "--seed", 62
        )
        whole = {"cecum_t1_a": (c3vd / "cecum_t1_a", 276), "colon phantom": (colon, PHANTOM_FRAMES)}
        whole["laparoscopy phantom"] = (cavity, PHANTOM_FRAMES)
        measuring.print_head("map of the first half of", "frames of", "found", "position mm", "rotation deg")
        for name, (video, count) in whole.items():
            run = measuring.run_once(video, folder / f"{video.name}-map", "--frames", f":{count // 2}")
            table = folder / f"{video.name}.csv"
            print_located(name, run, "its second half", video, f"{count // 2}:", table, truth=True)
            for other, (place, _) in whole.items():
                if other != name:
                    print_located(name, run, other, place, "::5", table, truth=False)
            if name == "cecum_t1_a":
                print_located(name, run, "trans_t1_a", c3vd / "trans_t1_a", ":", table, truth=False)


if __name__ == "__main__":
    main()
