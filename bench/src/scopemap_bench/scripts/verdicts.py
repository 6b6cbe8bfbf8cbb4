"""Whether the report's word can be believed: results with truth, good or not by the word and by the error.

    python -m scopemap_bench.scripts.verdicts [--out FOLDER] [--data DATA]

A result is right where the camera path is off by at most 3 % of its length (RMSE of positions after a Sim(3) alignment
over the true path's length) and the surface by at most 5 % of its distance: what a frame's depth says of each pixel,
in the scale of the path, against the true point, both seen from the camera and turned to fit each other (a constant
tilt of all cameras is no error of shape), median over pixels, then over frames. With --data also real clips. Where
--out has a result it is not made again.
"""

from __future__ import annotations

import subprocess
from collections import defaultdict
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.reading import read_calibration
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import ScopemapError
from scopemap.evaluation.poses import match
from scopemap.io.opening import open_sequence
from scopemap.io.reference import read_reference
from scopemap.io.run_folder import RunFolder
from scopemap.report.verdict import verdict
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.datasets.c3vd import CAMERA
from scopemap_bench.scripts import measuring, overview

MOST_PATH_ERROR, MOST_SURFACE_ERROR = 0.03, 0.05
WORLDS = tuple(product(("colon", "laparoscopy"), (31, 32)))
LENS = PinholeCamera(160.0, 160.0, 159.5, 127.5, 320, 256)
"""Of the phantoms."""
DIFFICULT = {
    "blur, smoke": ("--events", "blur:20-26,smoke:40-46"),
    "motion blur, H.264, lagging exposure": (
        *("--set", "shutter=0.8", "--set", "h264_crf=30", "--set", "indirect=0.15"),
        *("--set", "auto_exposure=true", "--set", "exposure_lag_frames=4"),
    ),
    "breathing": ("--deform", "--set", "breath_frames=60"),
    "fluid over the lens": ("--events", "fluid:20-40"),
    "faint texture": ("--set", "texture=0.25"),
}


class Case(NamedTuple):
    """A run: the row of the table, its name, the phantom or the folder that it reads, further words of the run."""

    group: str
    name: str
    source: tuple[object, ...] | Path
    words: tuple[object, ...] = ()


class Outcome(NamedTuple):
    """A case's word ("no result" where the run failed), errors of path and surface, shares, and reasons for doubt."""

    case: Case
    word: str
    path: float
    surface: float
    reasons: str

    @property
    def right(self) -> bool:
        """Whether both errors are small."""
        return self.path <= MOST_PATH_ERROR and self.surface <= MOST_SURFACE_ERROR


def typed(lens: PinholeCamera) -> tuple[str, str]:
    """Return the words that state a lens."""
    return "--camera", f"{lens.fx} {lens.fy} {lens.cx} {lens.cy}"


def phantom_cases(out: Path) -> list[Case]:
    """Return the runs of phantoms; calibration files are written to `out`."""
    found = []
    for scene, seed in (*WORLDS, ("colon", 33), ("laparoscopy", 33), ("colon", 34), ("laparoscopy", 34)):
        frames = 60 if seed < 34 else 100
        found.append(
            Case(f"{scene}, as it is", f"{scene}-{seed}", ("--scene", scene, "--seed", seed, "--frames", frames))
        )
    found += [Case("tube, no texture", f"tube-{n}", ("--scene", "tube", "--seed", n, "--frames", 60)) for n in (31, 32)]
    small, large = LENS.cropped(-80, -64, 480, 384), LENS.resized(640, 512)
    for name, lens in (("small", small), ("large", large)):
        write_calibration(lens, out / f"{name}.yaml")
    changes: list[tuple[str, str, tuple[object, ...]]] = [
        ("scale stated three times too large", "scaled", ("--near-far", "40:250")),
        *(
            (f"focal length off by {percent} %", f"focal{sign * percent:+d}", typed(replace(LENS, fx=f, fy=f)))
            for percent in (2, 5, 10, 20)
            for sign in (1, -1)
            for f in (160 * (1 + sign * percent / 100),)
        ),
        *(
            (
                f"principal point off by {percent} % of the width",
                f"point{percent}-{x}-{y}",
                typed(LENS.cropped(x, y, 320, 256)),
            )
            for percent, px in ((5, 16), (10, 32))
            for x, y in ((px, 0), (-px, 0), (0, px))
        ),
        *(("another lens's field of view", f"fov{fov}", ("--fov", fov)) for fov in (60, 115)),
        *(("frames dropped", f"every{step}", ("--frames", f"::{step}")) for step in (4, 6)),
        ("calibration of another size", "small", ("--camera", out / "small.yaml", "--camera-fit", "scale")),
        ("calibration of another size", "large", ("--camera", out / "large.yaml", "--camera-fit", "crop:0,0")),
    ]
    for (group, name, words), (scene, seed) in product(changes, WORLDS):
        if seed == WORLDS[0][1] or name.startswith(("focal+5", "focal-5", "focal+10", "focal-10")):
            found.append(
                Case(group, f"{scene}-{seed}-{name}", ("--scene", scene, "--seed", seed, "--frames", 60), words)
            )
    for (name, more), (scene, seed) in product(DIFFICULT.items(), WORLDS[::2]):
        words = ("--scene", scene, "--seed", seed + 10, "--frames", 60, *more)
        found.append(Case(name, f"{scene}-{name.split()[0].strip(',')}", words))
    return found


def real_cases(data: Path, out: Path) -> list[Case]:
    """Return the runs of C3VD's cecum_t1_a, whose true depth is known every 30th frame."""
    clip = overview.clips(data, out)["C3VD cecum_t1_a"].truth(out / "cecum")
    parts = [(f"cecum-{first}", ("--frames", f"{first}:{first + 92}")) for first in (0, 92, 184)]
    found = [Case("C3VD cecum_t1_a, in parts", name, clip, words) for name, words in parts]
    for name, factor, shift in (("focal+10", 1.1, 0), ("focal-10", 0.9, 0), ("focal-20", 0.8, 0), ("point", 1, 135)):
        lens = replace(CAMERA, polynomial=tuple(factor * term for term in CAMERA.polynomial), cx=CAMERA.cx + shift)
        write_calibration(lens, out / f"cecum-{name}.yaml")
        words = ("--camera", out / f"cecum-{name}.yaml", *parts[0][1])
        found.append(Case("C3VD, another lens stated", f"cecum-{name}", clip, words))
    return found


def surface_error(run: Path, truth: Path, scale: float) -> float:
    """Return how far a run's depth, times `scale`, is from the true points, as a share of their distance (median).

    Infinite where no frame has both.
    """
    folder, sequence, errors = RunFolder(run), open_sequence(truth), []
    camera, true_lens, file = folder.camera, sequence.source.camera, folder.source_camera_file
    assert true_lens is not None
    assert file is not None
    lens = read_calibration(file, (true_lens.width, true_lens.height)).camera
    pixels = sequence.camera.project(true_lens.unproject(lens.project(camera.rays))).astype(np.float32)
    for frame, true in sequence:
        depth_mm = folder.depth.read(frame.index)
        if depth_mm is None or true is None or true.depth_mm is None:
            continue
        points = true.depth_mm[..., None] * sequence.camera.rays
        points = cv2.remap(points, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST, borderValue=(np.nan,) * 3)
        both = np.isfinite(points).all(-1) & (depth_mm > 0)
        ours, points = scale * depth_mm[both, None] * camera.rays[both], points[both]
        distance = np.linalg.norm(points, axis=1, keepdims=True)
        ours, points = ours / distance, points / distance
        left, _, right = np.linalg.svd(points.T @ ours)
        R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        errors.append(float(np.median(np.linalg.norm(ours @ R.T - points, axis=1))))
    return float(np.median(errors)) if errors else np.inf


def outcome(case: Case, out: Path) -> Outcome:
    """Draw, run and measure a case."""
    source = case.source
    if not isinstance(source, Path):
        name = case.name if not case.words else "-".join(case.name.split("-")[:2])
        source = measuring.phantom(out / "phantoms" / name, *source)
    try:
        run = measuring.run_once(source, out / "runs" / case.name, *case.words)
    except subprocess.CalledProcessError:
        return Outcome(case, "no result", np.inf, np.inf, "")
    said = verdict(RunFolder(run))
    reasons = ", ".join(reason.code for reason in said.reasons if reason.level in ("bad", "doubtful"))
    reference = read_reference(source)
    assert reference is not None
    try:
        matched = match(read_trajectory(run), reference, "sim3")
    except ScopemapError:
        return Outcome(case, said.word, np.inf, np.inf, reasons)
    true, ours = (T[matched.tracked, :3, 3] for T in (matched.reference, matched.aligned))
    length_mm = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    path = float(np.sqrt(((ours - true) ** 2).sum(1).mean()) / length_mm)
    return Outcome(case, said.word, path, surface_error(run, source, matched.similarity.scale), reasons)


def print_table(outcomes: list[Outcome]) -> None:
    """Print a row for each group, the two shares, and what was misjudged."""
    groups = defaultdict(list)
    for found in outcomes:
        groups[found.case.group].append(found)
    measuring.print_head("what", "runs", "Good, right", "Good, wrong", "not Good, right", "not Good, wrong")
    for group, some in (groups | {"all": outcomes}).items():
        kinds = [sum((o.word == "good", o.right) == kind for o in some) for kind in product((True, False), repeat=2)]
        measuring.print_row(group, len(some), *kinds)
    good, wrong = [o for o in outcomes if o.word == "good"], [o for o in outcomes if not o.right]
    print(f"\nOf those called Good {sum(o.right for o in good) / max(len(good), 1):.0%} are right (wanted: 95 %).")
    caught = sum(o.word != "good" for o in wrong)
    print(f"Of the wrong ones {caught / max(len(wrong), 1):.0%} are not called Good (wanted: 90 %).\n")
    measuring.print_head("misjudged", "word", "path off", "surface off", "reasons")
    for o in outcomes:
        if (o.word == "good") != o.right:
            measuring.print_row(o.case.name, o.word, f"{o.path:.1%}", f"{o.surface:.1%}", o.reasons)


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        out.mkdir(parents=True, exist_ok=True)
        listed = phantom_cases(out) + (real_cases(options.data, out) if options.data else [])
        print_table([outcome(case, out) for case in listed])


if __name__ == "__main__":
    main()
