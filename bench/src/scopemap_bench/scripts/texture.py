"""How sharp and true is the texture of a surface: against frames that it was not made of.

    python -m scopemap_bench.scripts.texture --data FOLDER [--out FOLDER] [--only NAME ...]

A run of each clip, and its texture made again without every fifth frame. From the poses of these the surface is
rendered at the video's resolution, with vertex colours and with the texture, and compared with the frame where the
surface is seen and the mask allows it. The vertex colours are of all frames, so they have seen the frame. SSIM: mean
structural similarity (7 x 7 px) of grey values, and in brackets that after a blur of 1 px, which leaves less of the
frame's own noise. Detail: standard deviation of the Laplacian after a blur of 1 px, over that of the frame.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.similarity import structural_similarity
from scopemap.result.result import Result
from scopemap.runner.reread_frames import open_input
from scopemap.runner.texturing import frames_of_surface, read_again, textured
from scopemap_bench.scripts import measuring

LEFT_OUT_EVERY = 5
EDGE_PX = 7
"""Width of the window of SSIM: pixels whose window leaves the surface are not compared."""
CLIPS = {
    "Hamlyn rectified01": ("endoscopy/hamlyn/rectified01_part",),
    "laparoscopy_rvim 60:120": ("endoscopy/video/laparoscopy_rvim.mp4", "--frames", "60:120"),
    "C3VD cecum_t1_a 0:120": ("endoscopy/c3vd/cecum_t1_a", "--frames", "0:120"),
    "colonoscopy_nflba_03 0:60": ("endoscopy/video/colonoscopy_nflba_03.mp4", "--frames", "0:60"),
}


@dataclass(frozen=True)
class Likeness:
    """SSIM, SSIM after a blur of 1 px, and fine detail over the frame's."""

    ssim: float
    blurred: float
    detail: float


def likeness(mesh: trimesh.Trimesh, frame: Frame) -> Likeness:
    """Return how a rendering of a mesh is like a frame of the video's size, which has pose and mask."""
    assert frame.T_world_camera is not None
    view = render_mesh(mesh, frame.camera, frame.T_world_camera)
    known = frame.valid & np.isfinite(view.depth_mm)
    shown = lit_like(view, frame.camera, frame.rgb, np.where(known, view.depth_mm, np.nan)).rgb
    inside = cv2.erode(known.astype(np.uint8), np.ones((EDGE_PX, EDGE_PX), np.uint8)) > 0
    grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (frame.rgb, shown)]
    blurred = [cv2.GaussianBlur(picture, (0, 0), 1.0) for picture in grey]
    fine = [cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0) for picture in grey]
    detail = [float(cv2.Laplacian(picture, cv2.CV_32F)[inside].std()) for picture in fine]
    similar = (float(structural_similarity(*pair)[inside].mean()) for pair in (grey, blurred))
    return Likeness(*similar, detail[1] / detail[0])


def measure(name: str, run: Path) -> None:
    """Print the row of a run."""
    result, (sequence, mask) = Result(run), open_input(run)
    table = frames_of_surface(result)
    numbers = table["index"].tolist()
    left_out = numbers[LEFT_OUT_EVERY // 2 :: LEFT_OUT_EVERY]
    quality = dict(zip(numbers, table["quality"].tolist(), strict=True))
    frames = {}
    for frame in map(mask, sequence.frames()):
        if frame.index in quality and (depth_mm := result.depth.read(frame.index)) is not None:
            # Depth is unknown on instruments.
            valid = frame.valid & np.isfinite(depth_mm)
            frames[frame.index] = replace(frame, valid=valid, quality=float(np.nan_to_num(quality[frame.index])))
    kept = table.only(~np.isin(table["index"], left_out))
    started = time.perf_counter()
    mesh = textured(result.mesh, kept, frames.__getitem__, sequence)
    elapsed_s = time.perf_counter() - started
    assert mesh is not None
    source = sequence.rectifier.source
    camera: PinholeCamera = sequence.camera.resized(source.width, source.height)
    rectifier, size = Rectifier(source, camera), (source.width, source.height)
    pose_of = dict(zip(numbers, table["T_world_camera"], strict=True))
    rows = []
    for picture in read_again(sequence.source, sequence.selection, left_out):
        if picture.index not in left_out:
            continue
        small = frames[picture.index]
        valid = cv2.resize(small.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        full = Frame(picture.index, 0.0, rectifier.image(picture.rgb), camera, valid)
        full = replace(full, T_world_camera=pose_of[picture.index])
        rows.append([likeness(result.mesh, full), likeness(mesh, full)])
    cells = []
    for one in zip(*rows, strict=True):
        ssim, blurred, detail = (
            float(np.mean([getattr(row, part) for row in one])) for part in Likeness.__annotations__
        )
        cells += [f"{ssim:.3f} ({blurred:.3f})", f"{detail:.0%}"]
    side = "{} x {}".format(*mesh.visual.material.image.size)
    measuring.print_row(name, len(rows), *cells, side, f"{elapsed_s:.1f}")


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=list(CLIPS), help="names of clips")
    options = parser.parse_args()
    heads = ("vertex colours: SSIM", "detail", "texture: SSIM", "detail", "texture px", "seconds")
    with measuring.folder_or_scratch(options.out) as out:
        measuring.print_head("clip", "frames left out", *heads)
        for name in options.only:
            path, *arguments = CLIPS[name]
            run = out / name.replace(" ", "-").replace(":", "-")
            measure(name, measuring.run_once(options.data / path, run, *arguments))


if __name__ == "__main__":
    main()
