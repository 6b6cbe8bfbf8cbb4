"""What a run makes of an unknown lens: lenses of known models, and those of real endoscopes with and without `--scope`.

    python -m scopemap_bench.scripts.unknown_lenses [--data DATA] [--out FOLDER]

Phantoms of 120 frames are given as plain pictures, every fourth, to whole runs, which decide the lens in the first
frames or by the motion of all of them. First table: lenses of the models that are tried. Second table: lenses of
endoscopes as published; the median over `SEEDS` of how far fx at the picture's centre is off.
With --data, a third table: pictures of real clips whose lens is known, without their calibration and with it.
A lens that is the source of its kind's prior (`scopemap.input.scopes`) is marked; its kind cannot be wrong on it.
"""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.engine.cameras.rectification import working_size
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.scopes import KINDS
from scopemap.result.result import Result
from scopemap_bench.datasets import c3vd
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec, SceneName
from scopemap_bench.scripts import measuring

SIZE = (320, 256)
EVERY = 4
FRAMES = 120
# Scene, kind of the lens, horizontal field of view in degrees, seed, whether tissue breathes.
MODELS: tuple[tuple[SceneName, str, float, int, bool], ...] = (
    ("laparoscopy", "pinhole", 60.0, 301, False),
    ("laparoscopy", "equidistant fisheye", 75.0, 303, False),
    ("laparoscopy", "orthographic fisheye", 100.0, 304, False),
    ("colon", "pinhole", 75.0, 306, False),
    ("laparoscopy", "pinhole", 90.0, 302, True),
)
SEEDS = (511, 512, 513)


class Endoscope(NamedTuple):
    """A real lens: its kind, name, camera, the scene that it is drawn in, and whether its kind's prior rests on it."""

    kind: str
    name: str
    camera: CameraModel
    scene: SceneName
    is_source: bool = False


def lens_of(kind: str, fov_deg: float, size: tuple[int, int] = SIZE, across: float = 1.0) -> CameraModel:
    """Return a lens of a kind for pictures of a size, whose field of view is `across` picture widths wide."""
    radius = {"pinhole": math.tan, "equidistant fisheye": float, "orthographic fisheye": math.sin}[kind]
    focal_px = across * size[0] / 2 / radius(math.radians(fov_deg / 2))
    plane = PinholeCamera(focal_px, focal_px, (size[0] - 1) / 2, (size[1] - 1) / 2, *size)
    return FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane


# Labels are of the widest chord: of C3VD's colonoscope, labelled 170 degrees, 1.13 widths (corners are cut); of
# MiroCam, labelled 170 degrees, the diagonal of a square, through an equidistant fisheye. Round fields: the width.
_CUT_CORNERS = 2 * 769.24 * math.sin(math.radians(85)) / 1350
_DIAGONAL = math.sqrt(2)
_SQUARE = (320, 320)
ENDOSCOPES = (
    # EndoMapper (doi 10.1038/s41597-023-02564-7), Endoscope_01, calibrated.
    Endoscope(
        *("colonoscope", "EndoMapper 01, calibrated"),
        FisheyeCamera(
            PinholeCamera(717.6911, 718.0214, 734.7278, 552.0724, 1440, 1080),
            (-0.1396589, -0.0003139987, 0.001505504, -0.0001316715),
        ),
        "colon",
    ),
    Endoscope("colonoscope", "C3VD's CF-HQ190L, calibrated", c3vd.CAMERA, "colon", is_source=True),
    Endoscope(
        *("gastroscope", "GIF-H190, label 140 deg"),
        lens_of("orthographic fisheye", 140.0, (320, 256), _CUT_CORNERS),
        "laparoscopy",
    ),
    # settings/new_lung.yaml of github.com/SIRGLab/bronchoscopy-dataset-and-benchmark.
    Endoscope(
        *("bronchoscope", "SIRGLab's, calibrated"),
        OpenCvCamera(
            PinholeCamera(447.679079249249, 448.768431364843, 252.560061902772, 233.658637132913, 480, 480),
            (0.0237323472870419, -0.320432607152857, 0.0, 0.0),
        ),
        "colon",
    ),
    # Rectified, as by Endo-Depth-and-Motion (arXiv 2103.16525).
    Endoscope(
        *("laparoscope", "Hamlyn 06, calibrated"),
        PinholeCamera(765.8236885, 765.8236885, 276.4727783203125, 253.6752815246582, 640, 480),
        "laparoscopy",
    ),
    Endoscope(
        *("laparoscope", "SCARED, calibrated"),
        PinholeCamera(1054.0, 1054.0, 639.5, 511.5, 1280, 1024),
        *("laparoscopy", True),
    ),
    Endoscope("cystoscope", "CYF-VH, label 120 deg", lens_of("equidistant fisheye", 120.0), "laparoscopy"),
    # doi 10.1089/end.2008.0371: 62.9 degrees, distorted by -9.7 % at the edge, as an equidistant lens is.
    Endoscope("ureteroscope", "XURF-P5, measured", lens_of("equidistant fisheye", 62.9), "colon", is_source=True),
    # doi 10.1002/lary.24971, 4 mm: at the edge distances are 80 % and sizes 52 % of a pinhole's, as through an
    # equidistant lens at 43.3 degrees.
    Endoscope("sinus", "4 mm telescopes, measured", lens_of("equidistant fisheye", 86.6), "colon"),
    Endoscope(
        *("capsule", "PillCam SB3, label 156 deg"),
        lens_of("equidistant fisheye", 156.0, _SQUARE, _DIAGONAL),
        "colon",
    ),
    # EndoSLAM (arXiv 2006.16670).
    Endoscope(
        *("capsule", "MiroCam, calibrated"),
        FisheyeCamera(PinholeCamera(156.04, 155.75, 178.56, 181.80, 320, 320), KINDS["equidistant fisheye"]),
        *("colon", True),
    ),
)


def drawn(camera: CameraModel, scene: SceneName, seed: int, folder: Path, *, deform: bool = False) -> Path:
    """Return a folder of plain pictures of a phantom through a lens, drawn unless it is there."""
    last = folder / f"{FRAMES - EVERY:06d}.png"
    if last.is_file():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    file = folder.with_suffix(".yaml")
    write_calibration(camera, file)
    spec = PhantomSpec(scene, FRAMES, camera.width, camera.height, seed=seed, deform=deform, camera_file=file)
    model = prepare(spec)
    for index in range(0, FRAMES, EVERY):
        cv2.imwrite(str(folder / f"{index:06d}.png"), render_frame(model, index)[0][..., ::-1])
    return folder


class Found(NamedTuple):
    """What a run makes of a lens: focal length at the picture's centre over the true one, less 1, and its source."""

    off: float
    source: str

    @property
    def is_known(self) -> bool:
        """Whether the run has decided it."""
        return self.source.startswith("estimated")


def found_lens(pictures: Path, camera: CameraModel, scope: str = "") -> Found:
    """Return what a run of pictures through a camera makes of it; scope : kind of the endoscope, if that is stated."""
    words = ("--scope", scope) if scope else ()
    run = measuring.run_once(pictures, pictures.with_name(f"{pictures.name}-run{scope and '-scope'}"), *words)
    ours, facts = Result(run).camera, measuring.provenance(run)["camera"]
    return Found(off_by(ours, camera), facts["source"])


def off_by(ours: PinholeCamera, camera: CameraModel) -> float:
    """Return the focal length of a working camera over that at the picture's centre, less 1."""
    return float(ours.fx * camera.width / (camera.central.fx * ours.width) - 1)


def print_models(folder: Path) -> None:
    """Print how far the estimated focal length is off at the picture's centre, or that the run does not know."""
    measuring.print_head("scene, lens", "true f / width", "fx off", "camera's source, as a run states it")
    for scene, kind, fov_deg, seed, deform in MODELS:
        camera = lens_of(kind, fov_deg)
        pictures = drawn(camera, scene, seed, folder / f"lens-{seed}", deform=deform)
        found = found_lens(pictures, camera)
        verdict = f"{found.off:+.1%}" if found.is_known else f"unknown; assumed {found.off:+.0%}"
        name = f"{scene}{', breathing' if deform else ''}, {kind}, {fov_deg:g} deg"
        measuring.print_row(name, f"{camera.central.fx / SIZE[0]:.3f}", verdict, found.source.split(";")[0])


def print_endoscopes(folder: Path) -> None:
    """Print the errors through each lens of an endoscope, and their medians."""
    heads = ("70 deg, assumed", "estimated", "estimated with `--scope`", "known without / with")
    measuring.print_head("kind", "lens", "true f / width", *heads)
    table = []
    for number, one in enumerate(ENDOSCOPES):
        camera = one.camera.resized(*working_size(one.camera.width, one.camera.height))
        rows, known = [], np.zeros(2, int)
        for seed in SEEDS:
            pictures = drawn(camera, one.scene, seed, folder / f"{number}-{one.kind}-{seed}")
            found = [found_lens(pictures, camera, scope) for scope in ("", one.kind)]
            rows.append([abs(off_by(open_sequence(pictures).camera, camera)), *(abs(each.off) for each in found)])
            known += [each.is_known for each in found]
        table.append(rows)
        cells = [f"{value:.1%}" for value in np.median(rows, axis=0)]
        name = f"{one.name}{' (source of the prior)' if one.is_source else ''}"
        share = f"{camera.central.fx / camera.width:.3f}"
        measuring.print_row(one.kind, name, share, *cells, f"{known[0]} / {known[1]} of {len(SEEDS)}")
    errors, apart = np.array(table), np.array([not one.is_source for one in ENDOSCOPES])
    for name, some in (("all", errors), ("not a prior's source", errors[apart])):
        cells = [f"{value:.1%}" for value in np.median(some, axis=(0, 1))]
        measuring.print_row("median", name, "", *cells, "")


REAL = {
    "C3VD cecum_t1_a, a fisheye": ("endoscopy/c3vd/cecum_t1_a", "*_color.jpg"),
    "Hamlyn laparoscopy, 45 deg": ("endoscopy/hamlyn/rectified01_part", "image01/*.jpg"),
}
"""Clips below the folder of the data, and their pictures."""


def print_real(data: Path, folder: Path) -> None:
    """Print what a run makes of pictures of real clips without their calibration, and the path with and without."""
    heads = ("assumed, off by", "found, off by", "ATE, mm", "ATE with calibration, mm", "source, as the run states it")
    measuring.print_head("clip", "true f / width", *heads)
    for number, (name, (clip, pattern)) in enumerate(REAL.items()):
        pictures = folder / f"real-{number}"
        pictures.mkdir(exist_ok=True)
        found = sorted((data / clip).glob(pattern), key=lambda file: int(re.sub(r"\D", "", file.name)))
        for index, file in enumerate(found):
            shutil.copyfile(file, pictures / f"{index:06d}{file.suffix}")
        camera, assumed = open_sequence(data / clip).source.camera, open_sequence(pictures).camera
        assert camera is not None
        lens = found_lens(pictures, camera)
        runs = folder / f"{pictures.name}-run", measuring.run_once(data / clip, folder / f"{pictures.name}-calibrated")
        paths = [measuring.evaluated(run, "--truth", data / clip, "--align", "sim3") for run in runs]
        cells = (f"{off_by(assumed, camera):+.1%}", f"{lens.off:+.1%}" if lens.is_known else "stays assumed")
        errors = (measuring.cell(one, ".3f", "ate_rmse_mm") for one in paths)
        measuring.print_row(name, f"{camera.central.fx / camera.width:.3f}", *cells, *errors, lens.source.split(";")[0])


def main() -> None:
    """Print the tables."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        print_models(folder)
        print()
        print_endoscopes(folder)
        if options.data is not None:
            print()
            print_real(options.data, folder)


if __name__ == "__main__":
    main()
