"""Whether the report's word can be believed: results with truth, by their word and by their error.

    python -m scopemap_bench.scripts.verdicts [--out FOLDER] [--data DATA]

A result is right where the path is off by at most 3 % (RMSE of positions after a Sim(3) alignment over the length of
the true path) and the surface by at most 5 %: distance between a pixel's point by the run's depth, in the path's scale,
and the true one over its distance; both as the camera sees them, turned to fit each other, for a constant tilt of all
cameras bends no shape; median over pixels, then over frames. --data adds real clips. Results in --out are kept.
"""

from __future__ import annotations

import subprocess
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.cameras.formats.reading import read_calibration
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import AlignmentError
from scopemap.evaluation.poses import match
from scopemap.io.opening import open_sequence
from scopemap.io.reference import read_reference
from scopemap.io.run_folder import RunFolder
from scopemap.report.verdict import verdict
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.datasets.c3vd import CAMERA
from scopemap_bench.scripts import measuring, overview

MOST_PATH, MOST_SURFACE = 0.03, 0.05
Words = tuple[object, ...]
SCENES, SEEDS = ("colon", "laparoscopy"), (31, 32)
CODED = ("shutter=0.8", "h264_crf=30", "indirect=0.15", "auto_exposure=true", "exposure_lag_frames=4")
DIFFICULT: dict[str, Words] = {
    "blur, smoke": ("--events", "blur:20-26,smoke:40-46"),
    "motion blur, H.264, lagging exposure": tuple(word for setting in CODED for word in ("--set", setting)),
    "breathing": ("--deform", "--set", "breath_frames=60"),
    "fluid over the lens": ("--events", "fluid:20-40"),
    "faint texture": ("--set", "texture=0.25"),
}


class Case(NamedTuple):
    """A run: row of the table, name, words that draw its phantom or a folder, further words of the run."""

    group: str
    name: str
    source: Words | Path
    words: Words = ()


class Outcome(NamedTuple):
    """A case's word ("no result" where the run failed), errors of path and surface, shares, and reasons for doubt."""

    case: Case
    word: str
    path: float = np.inf
    surface: float = np.inf
    reasons: str = ""

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether it is called Good, and whether it is right."""
        return self.word == "good", self.path <= MOST_PATH and self.surface <= MOST_SURFACE


def drawn(scene: str, seed: int, *more: object) -> Words:
    """Return the words that draw a phantom of 320x256 px."""
    return ("--scene", scene, "--seed", seed, "--frames", 100 if seed == 34 else 60, *more)


def stated(focal_px: float = 160.0, x: float = 159.5, y: float = 127.5) -> Words:
    """Return the words that state a lens, px; that of the phantoms by default."""
    return ("--camera", f"{focal_px} {focal_px} {x} {y}")


def phantom_cases() -> list[Case]:
    """Return the runs of phantoms."""
    plain = [*product(SCENES, (*SEEDS, 33, 34)), *product(["tube"], SEEDS)]
    found = [Case(f"{scene}, as it is", f"{scene}-{seed}", drawn(scene, seed)) for scene, seed in plain]
    changes: list[tuple[str, str, Words]] = [("scale stated three times too large", "scaled", ("--near-far", "40:250"))]
    for percent, sign in product((2, 5, 10, 20), (1, -1)):
        lens = stated(160 * (1 + sign * percent / 100))
        changes.append((f"focal length off by {percent} %", f"focal{sign * percent:+d}", lens))
    for (percent, px), (right, down) in product(((5, 16), (10, 32)), ((1, 0), (-1, 0), (0, 1))):
        x, y = px * right, px * down
        group, lens = f"principal point off by {percent} % of the width", stated(x=159.5 - x, y=127.5 - y)
        changes.append((group, f"point{percent}-{x}-{y}", lens))
    for view_deg in (60, 115):
        lens = stated(160 / np.tan(np.radians(view_deg / 2)))
        changes.append(("another lens's field of view", f"view{view_deg}", lens))
    changes += [("frames dropped", f"every{step}", ("--frames", f"::{step}")) for step in (4, 6)]
    fast = ("--preset", "realtime")
    changes += [("realtime", "fast", fast), ("realtime, as tracked", "plain", (*fast, "--set", "mapping.method=none"))]
    for sign in (1, -1):
        lens = stated(160 * (1 + sign / 10))
        changes.append(("realtime, focal length off by 10 %", f"fast{sign}", (*fast, *lens)))
    changes.append(("calibration of another size", "small", stated(160 / 1.5)))
    changes.append(("calibration of another size", "large", stated(320, 319.5, 255.5)))
    for (group, name, words), scene, seed in product(changes, SCENES, SEEDS):
        if seed == SEEDS[0] or name in ("focal+5", "focal-5", "focal+10", "focal-10"):
            found.append(Case(group, f"{scene}-{seed}-{name}", drawn(scene, seed), words))
    for (name, words), scene in product(DIFFICULT.items(), SCENES):
        found.append(Case(name, f"{scene}-{name.split()[0].strip(',')}", drawn(scene, 41, *words)))
    return found


def real_cases(data: Path, out: Path) -> list[Case]:
    """Return the runs of C3VD's cecum_t1_a, whose true depth is known every 30th frame."""
    clip = overview.clips(data, out)["C3VD cecum_t1_a"].truth(out / "cecum")
    parts = [(f"cecum-{first}", ("--frames", f"{first}:{first + 92}")) for first in (0, 92, 184)]
    found = [Case("C3VD cecum_t1_a, in parts", name, clip, words) for name, words in parts]
    for name, factor, shift in (("focal+10", 1.1, 0), ("focal-10", 0.9, 0), ("focal-20", 0.8, 0), ("point", 1, 135)):
        lens = replace(CAMERA, polynomial=tuple(factor * term for term in CAMERA.polynomial), cx=CAMERA.cx + shift)
        write_calibration(lens, file := out / f"cecum-{name}.yaml")
        found.append(Case("C3VD, another lens stated", f"cecum-{name}", clip, ("--camera", file, *parts[0][1])))
    return found


def surface_error(run: Path, truth: Path, scale: float) -> float:
    """Return a run's surface error, a share; infinite without depth of both. scale : of the path to the true one."""
    folder, sequence, errors = RunFolder(run), open_sequence(truth), []
    camera, true_lens, file = folder.camera, sequence.source.camera, folder.source_camera_file
    assert true_lens is not None
    assert file is not None
    lens = read_calibration(file, (true_lens.width, true_lens.height)).camera
    pixels = sequence.camera.project(true_lens.unproject(lens.project(camera.rays))).astype(np.float32)
    inside = set(folder.frames["index"][folder.frames.place == 0].tolist())
    for frame, true in sequence:
        depth_mm = folder.depth.read(frame.index) if frame.index in inside else None
        if depth_mm is None or true is None or true.depth_mm is None:
            continue
        points = true.depth_mm[..., None] * sequence.camera.rays
        points = cv2.remap(points, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST, borderValue=(np.nan,) * 3)
        both = np.isfinite(points).all(-1) & (depth_mm > 0)
        distance_mm = np.linalg.norm(points[both], axis=1, keepdims=True)
        points, ours = points[both] / distance_mm, scale * depth_mm[both, None] * camera.rays[both] / distance_mm
        left, _, right = np.linalg.svd(points.T @ ours)
        R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        errors.append(np.median(np.linalg.norm(ours @ R.T - points, axis=1)))
    return float(np.median(errors)) if errors else np.inf


def outcome(case: Case, out: Path) -> Outcome:
    """Draw, run and measure a case."""
    source = case.source
    if not isinstance(source, Path):
        name = "-".join(case.name.split("-")[:2])
        source = measuring.phantom(out / "phantoms" / name, *source)
    try:
        run = measuring.run_once(source, out / "runs" / case.name, *case.words)
    except subprocess.CalledProcessError:
        return Outcome(case, "no result")
    said, truth = verdict(RunFolder(run)), read_reference(source)
    assert truth is not None
    reasons = ", ".join(reason.code for reason in said.reasons if reason.level in ("bad", "doubtful"))
    try:
        matched = match(read_trajectory(run), truth, "sim3")
    except AlignmentError:
        return Outcome(case, said.word, reasons=reasons)
    true, ours = (T[matched.tracked, :3, 3] for T in (matched.reference, matched.aligned))
    length_mm = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    path = float(np.sqrt(((ours - true) ** 2).sum(1).mean()) / length_mm)
    return Outcome(case, said.word, path, surface_error(run, source, matched.similarity.scale), reasons)


def print_table(outcomes: list[Outcome]) -> None:
    """Print a row for each group, the two shares, and what was misjudged."""
    measuring.print_head("what", "runs", "Good, right", "Good, wrong", "not Good, right", "not Good, wrong")
    kinds = list(product((True, False), repeat=2))
    for group in dict.fromkeys([o.case.group for o in outcomes] + ["all"]):
        some = [o.kind for o in outcomes if group in (o.case.group, "all")]
        measuring.print_row(group, len(some), *map(some.count, kinds))
    good_right, good_wrong, _, other_wrong = map([o.kind for o in outcomes].count, kinds)
    print(f"\nOf those called Good {good_right / max(good_right + good_wrong, 1):.0%} are right (wanted: 95 %).")
    caught = other_wrong / max(good_wrong + other_wrong, 1)
    print(f"Of the wrong ones {caught:.0%} are not called Good (wanted: 90 %).\n")
    measuring.print_head("misjudged", "word", "path off", "surface off", "reasons")
    for o in outcomes:
        if o.kind[0] != o.kind[1]:
            measuring.print_row(o.case.name, o.word, f"{o.path:.1%}", f"{o.surface:.1%}", o.reasons)


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        out.mkdir(parents=True, exist_ok=True)
        cases = phantom_cases() + (real_cases(options.data, out) if options.data else [])
        print_table([outcome(case, out) for case in cases])


if __name__ == "__main__":
    main()
