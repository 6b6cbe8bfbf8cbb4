"""Whether the report's word can be believed: results with truth, by their word and by their error.

    python -m scopemap_bench.scripts.verdicts [--out FOLDER] [--data DATA] [--only GLOB ...]

A result is right where the path is off by at most 3 % (RMSE of positions after a Sim(3) alignment over the length of
the true path) and the surface by at most 5 %: distance between a pixel's point by the run's depth, in the path's scale,
and the true one over its distance; both as the camera sees them, turned to fit each other, for a constant tilt of all
cameras bends no shape; median over pixels, then over frames. --data adds real clips, which are judged by what is known
of them: by path or surface alone; the surface without a path in one median scale a frame; a camera at rest by its drift
over the median depth, at most 3 %. Clips of which only pairs of pixels are known are wrong where less than 90 % of
these are in order, and else left out of all counts but that of the runs. Results in --out are kept. --only: cases, by
name or row; * is any text. Each result is printed to standard error as it comes.
"""

from __future__ import annotations

import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.errors import AlignmentError
from scopemap.evaluation.clock import read_later
from scopemap.evaluation.poses import match
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.trajectory.trajectory import path_length_mm
from scopemap.result.reference import read_reference
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap.result.verdict import verdict
from scopemap_bench.evaluation.partial_truth import drift, pairs_in_order
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.verdict_cases import Case, phantom_cases, real_cases

MOST_PATH = 0.03
MOST_SURFACE = 0.05
LEAST_IN_ORDER = 0.9
UNKNOWN = float("nan")


class Outcome(NamedTuple):
    """A case's word ("no result" where the run failed), errors of path and surface, shares, and reasons for doubt.

    pairs : share of the pairs of pixels in order, where only these are known. What is not known is NaN.
    """

    case: Case
    word: str
    path: float = np.inf
    surface: float = np.inf
    reasons: str = ""
    pairs: float = UNKNOWN

    @property
    def kind(self) -> tuple[bool, bool] | None:
        """Whether it is called Good, and whether it is right; None where too little is known for the latter."""
        if self.pairs >= LEAST_IN_ORDER:
            return None
        wrong = self.path > MOST_PATH or self.surface > MOST_SURFACE or self.pairs < LEAST_IN_ORDER
        return self.word == "good", not wrong

    def cells(self) -> tuple[str, ...]:
        """Return its row of the table of results: name, word, errors in percent, reasons."""
        errors = ("" if np.isnan(share) else f"{share:.1%}" for share in (self.path, self.surface, self.pairs))
        return (self.case.name, self.word, *errors, self.reasons)


def surface_error(run: Path, truth: Path, scale: float | None) -> float:
    """Return a run's surface error, a share; infinite without depth of both.

    scale : of the path to the true one; None: the median ratio of the distances in each frame, where no path is known.
    """
    folder, sequence, errors = Result(run), open_sequence(truth), []
    camera, true_lens, file = folder.camera, sequence.source.camera, folder.source_camera_file
    assert true_lens is not None
    assert file is not None
    lens = read_calibration(file, (true_lens.width, true_lens.height)).camera
    pixels = sequence.camera.project(true_lens.unproject(lens.project(camera.rays))).astype(np.float32)
    inside = set(folder.frames["index"][folder.frames.submap == 0].tolist())
    for frame, true in sequence:
        depth_mm = folder.depth.read(frame.index) if frame.index in inside else None
        if depth_mm is None or true is None or true.depth_mm is None:
            continue
        points = true.depth_mm[..., None] * sequence.camera.rays
        points = cv2.remap(points, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST, borderValue=(np.nan,) * 3)
        both = np.isfinite(points).all(-1) & (depth_mm > 0)
        distance_mm = np.linalg.norm(points[both], axis=1, keepdims=True)
        points, ours = points[both] / distance_mm, depth_mm[both, None] * camera.rays[both] / distance_mm
        ours *= 1 / np.median(np.linalg.norm(ours, axis=1)) if scale is None else scale
        left, _, right = np.linalg.svd(points.T @ ours)
        R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        errors.append(np.median(np.linalg.norm(ours @ R.T - points, axis=1)))
    return float(np.median(errors)) if errors else np.inf


def path_error(run: Path, case: Case, truth: Path) -> tuple[float, float | None]:
    """Return the error of a run's path, a share, NaN where none is known, and the scale that brings it to the truth.

    Infinite, with a scale of 1, where the path cannot be aligned.
    """
    if case.known.at_rest:
        return drift(Result(run)), None
    if not case.known.path:
        return UNKNOWN, None
    reference = read_reference(truth)
    assert reference is not None
    try:
        matched = match(read_trajectory(run), read_later(reference, case.known.clock_s), "sim3")
    except AlignmentError:
        return np.inf, 1.0
    true, ours = (T[matched.tracked, :3, 3] for T in (matched.reference, matched.aligned))
    error_mm = np.sqrt(((ours - true) ** 2).sum(1).mean())
    return float(error_mm / path_length_mm(true)), matched.similarity.scale


def outcome(case: Case, out: Path) -> Outcome:
    """Draw, run and measure a case, by what is known of its truth."""
    source = case.source
    if not isinstance(source, Path):
        name = "-".join(case.name.split("-")[:2])
        source = measuring.phantom(out / "phantoms" / name, *source)
    try:
        run = measuring.run_once(source, out / "runs" / case.name, *case.words)
    except subprocess.CalledProcessError:
        return Outcome(case, "no result")
    said = verdict(Result(run))
    reasons = ", ".join(reason.code for reason in said.reasons if reason.level in ("bad", "doubtful"))
    path, scale = path_error(run, case, source)
    surface = surface_error(run, source, scale) if case.known.depth else UNKNOWN
    pairs = UNKNOWN
    if case.known.pairs is not None:
        right, count = pairs_in_order(Result(run), case.known.pairs)
        pairs = right / count
    return Outcome(case, said.word, path, surface, reasons, pairs)


def print_table(outcomes: list[Outcome]) -> None:
    """Print a row for each group, the three shares, and what was misjudged."""
    measuring.print_head("what", "runs", "Good, right", "Good, wrong", "not Good, right", "not Good, wrong")
    kinds = [(good, right) for good in (True, False) for right in (True, False)]
    found = [o.kind for o in outcomes]
    for group in dict.fromkeys([o.case.group for o in outcomes] + ["all"]):
        some = [o.kind for o in outcomes if group in (o.case.group, "all")]
        measuring.print_row(group, len(some), *(some.count(kind) for kind in kinds))
    good_right, good_wrong, other_right, other_wrong = (found.count(kind) for kind in kinds)

    def share(part: int, rest: int) -> str:
        return f"{part / (part + rest):.0%}" if part + rest else "none"

    print(f"\nOf those called Good {share(good_right, good_wrong)} are right (wanted: 95 %).")
    print(f"Of the wrong ones {share(other_wrong, good_wrong)} are not called Good (wanted: 95 %).")
    print(f"Of the right ones {share(good_right, other_right)} are called Good (wanted: 75 %).\n")
    measuring.print_head("misjudged", "word", "path off", "surface off", "pairs in order", "reasons")
    for o in outcomes:
        if o.kind in ((True, False), (False, True)):
            measuring.print_row(*o.cells())


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    parser.add_argument(
        "--only", nargs="+", default=["*"], metavar="GLOB", help="names or rows of cases; * is any text"
    )
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        out.mkdir(parents=True, exist_ok=True)
        cases = phantom_cases() + (real_cases(options.data, out) if options.data else [])
        outcomes = []
        for case in cases:
            if any(fnmatch(text, pattern) for text in (case.name, case.group) for pattern in options.only):
                outcomes.append(outcome(case, out))
                print("|", " | ".join(outcomes[-1].cells()), "|", file=sys.stderr, flush=True)
        print_table(outcomes)


if __name__ == "__main__":
    main()
