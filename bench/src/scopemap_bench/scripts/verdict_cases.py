"""The results that the table of verdicts counts: phantoms and real clips, and what is known of the truth of each."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scopemap.input.camera_files.writing import write_calibration
from scopemap_bench.datasets.c3vd import CAMERA
from scopemap_bench.scripts import overview

Words = tuple[object, ...]
FAST: Words = ("--preset", "realtime")
SCENES = ("colon", "laparoscopy")
SEEDS = (31, 32)
CODED = ("shutter=0.8", "h264_crf=30", "indirect=0.15", "auto_exposure=true", "exposure_lag_frames=4")
DIFFICULT: dict[str, Words] = {
    "blur, smoke": ("--events", "blur:20-26,smoke:40-46"),
    "motion blur, H.264, lagging exposure": tuple(word for setting in CODED for word in ("--set", setting)),
    "breathing": ("--deform", "--set", "breath_frames=60"),
    "fluid over the lens": ("--events", "fluid:20-40"),
    "faint texture": ("--set", "texture=0.25"),
}
# C3VD's recorded poses are ahead of the pictures of trans_t2_a, s: `scopemap evaluate --time-offset fit` on a run with
# the data set's own lens; the pictures themselves say two frames (test_evaluation_clock.py). One for all runs of
# the clip, since the clock is the recording's.
_TRANS_CLOCK_S = -0.072
# Hamlyn's own lens for rectified01, px (its intrinsics.txt).
_HAMLYN_LENS = (766.0, 311.9, 248.7)


class Known(NamedTuple):
    """What is known of a truth.

    path : poses are. at_rest : the camera is known not to move, which is the path. depth : true depth is. clock_s : by
    so much later the true poses are read, s. pairs : file of pairs of pixels in order of depth, where nothing else is.
    """

    path: bool = True
    at_rest: bool = False
    depth: bool = True
    clock_s: float = 0.0
    pairs: Path | None = None


class Case(NamedTuple):
    """A run: row of the table, name, words that draw its phantom or a folder, further words of the run, its truth."""

    group: str
    name: str
    source: Words | Path
    words: Words = ()
    known: Known = Known()


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
    changes += [("realtime", "fast", FAST), ("realtime, as tracked", "plain", (*FAST, "--set", "mapping.method=none"))]
    for sign in (1, -1):
        lens = stated(160 * (1 + sign / 10))
        changes.append(("realtime, focal length off by 10 %", f"fast{sign}", (*FAST, *lens)))
    changes.append(("calibration of another size", "small", stated(160 / 1.5)))
    changes.append(("calibration of another size", "large", stated(320, 319.5, 255.5)))
    for (group, name, words), scene, seed in product(changes, SCENES, SEEDS):
        if seed == SEEDS[0] or name in ("focal+5", "focal-5", "focal+10", "focal-10"):
            found.append(Case(group, f"{scene}-{seed}-{name}", drawn(scene, seed), words))
    for (name, words), scene in product(DIFFICULT.items(), SCENES):
        found.append(Case(name, f"{scene}-{name.split()[0].strip(',')}", drawn(scene, 41, *words)))
    return found


def real_cases(data: Path, out: Path) -> list[Case]:
    """Return the runs of real clips; files that they need are written to the folder `out`."""
    return c3vd_cases(data, out) + other_cases(data)


def c3vd_cases(data: Path, out: Path) -> list[Case]:
    """Return the runs of C3VD; true depth of cecum_t1_a is known every 30th frame, of trans_t2_a not at all."""
    clip, folder = overview.clips(data, out)["C3VD cecum_t1_a"].truth(out / "cecum"), data / "endoscopy" / "c3vd"
    parts = [(f"cecum-{first}", ("--frames", f"{first}:{first + 92}")) for first in (0, 92, 184)]
    found = [Case("C3VD cecum_t1_a, in parts", name, clip, words) for name, words in parts]
    for name, factor, shift in (("focal+10", 1.1, 0), ("focal-10", 0.9, 0), ("focal-20", 0.8, 0), ("point", 1, 135)):
        lens = replace(CAMERA, polynomial=tuple(factor * term for term in CAMERA.polynomial), cx=CAMERA.cx + shift)
        write_calibration(lens, file := out / f"cecum-{name}.yaml")
        found.append(Case("C3VD, another lens stated", f"cecum-{name}", clip, ("--camera", file, *parts[0][1])))
    trans, known = folder / "trans_t2_a", Known(depth=False, clock_s=_TRANS_CLOCK_S)
    lens_words = ("--camera", trans / "camera.yaml")
    return [
        *found,
        Case("C3VD, whole clips", "cecum-whole", clip),
        Case("C3VD, whole clips", "trans2-whole", trans, lens_words, known),
        Case("C3VD, whole clips", "trans1-whole", folder / "trans_t1_a"),
        Case("real clips, realtime", "cecum-fast", clip, FAST),
        Case("real clips, realtime", "trans2-fast", trans, (*FAST, *lens_words), known),
    ]


def other_cases(data: Path) -> list[Case]:
    """Return the runs of clips without true poses: Hamlyn, EndoNeRF, and videos of which pairs of pixels are known."""
    scopes, focal_px, x, y = data / "endoscopy", *_HAMLYN_LENS
    clip, known = scopes / "hamlyn" / "rectified01_part", Known(path=False)
    found = [Case("Hamlyn laparoscopy", "hamlyn-whole", clip, (), known)]
    for name, frames in (("0", "0:150"), ("75", "75:225"), ("150", "150:300"), ("every2", "::2")):
        found.append(Case("Hamlyn laparoscopy", f"hamlyn-{name}", clip, ("--frames", frames), known))
    for percent, sign in product((10, 20), (1, -1)):
        words = stated(focal_px * (1 + sign * percent / 100), x, y)
        found.append(Case("Hamlyn, another lens stated", f"hamlyn-focal{sign * percent:+d}", clip, words, known))
    found.append(Case("real clips, realtime", "hamlyn-fast", clip, FAST, known))
    pulling = scopes / "endonerf" / "pulling_soft_tissues"
    found.append(Case("EndoNeRF, camera at rest", "pulling", pulling, (), Known(path=False, at_rest=True)))
    for name in ("colonoscopy_nflba_03", "laparoscopy_rvim", "laparoscopy_endo3r_rgb3"):
        of_video = Known(path=False, depth=False, pairs=scopes / "ordinal" / f"{name}.csv")
        found.append(Case("videos, pairs of pixels", name, scopes / "video" / f"{name}.mp4", (), of_video))
    return found
