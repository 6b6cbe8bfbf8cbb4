"""EndoMapper-like input: a phantom seen by a colonoscope's fisheye, 1440x1080 at 40 frames per second, as video.

    python -m scopemap_bench.scripts.endomapper --out FOLDER [--frames 40] [--presets default realtime]

The phantom is rendered with a Kannala-Brandt lens of EndoMapper's kind, its frames, there and back until they are 320,
are coded as H.264, and laid out as the CLiMB challenge has it (docs/climb.md): the clip, the endoscope's geometrical
calibration, and the true poses as COLMAP's reference. Each row is one run of the command line on the folder, and on the
same clip at the working size, which tells what the large pictures cost: frames per second by the summary, processor
time of all threads, the largest parts of the time (they overlap), figures of the challenge, and what the check of an
exported submission finds wrong.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.climb.figures import climb_figures
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec

SIZE, RATE_HZ, LENGTH, CLIP = (1440, 1080), 40, 320, "Seq_900_a"
# A lens like that of EndoMapper's colonoscopes: 154 degrees wide.
LENS = (718.0, 718.0, 735.0, 552.0, -0.14, 0.0, 0.0015, -0.0001)
_SCALED = 4  # the working size is a fourth
_XML = """<rig>
  <camera>
    <camera_model type="calibu_fu_fv_u0_v0_kb4">
      <width> {} </width>
      <height> {} </height>
      <params>[ {} ]</params>
    </camera_model>
  </camera>
</rig>
"""


def write_calibration(file: Path, scale: int) -> None:
    """Write the lens of pictures that are `scale` times smaller, as EndoMapper's calibration file has it."""
    fx, fy, cx, cy, *distortion = LENS
    centre = [(c + 0.5) / scale - 0.5 for c in (cx, cy)]
    params = (fx / scale, fy / scale, *centre, *distortion)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(_XML.format(*(side // scale for side in SIZE), "; ".join(map(str, params))))


def write_layout(root: Path, poses: np.ndarray, scale: int) -> Path:
    """Write all but the video of a clip with poses (N, 4, 4), camera to world, mm; return the folder to run."""
    write_calibration(root / "Calibrations" / "Endoscope_01" / "Endoscope_01_geometrical.xml", scale)
    folder = root / CLIP
    (folder / "results_txt").mkdir(parents=True, exist_ok=True)
    (folder / f"{CLIP.rpartition('_')[0]}_info.json").write_text(json.dumps({"endoscope_number": 1}))
    (root / "scales.csv").write_text(f"sequence,scale_to_target\n{CLIP},1.0\n")
    lines = []
    for number, pose in enumerate(map(inverse, poses), start=1):
        w_last = Rotation.from_matrix(pose[:3, :3]).as_quat()
        values = " ".join(f"{value:.9g}" for value in (*np.roll(w_last, 1), *pose[:3, 3]))
        lines.append(f"{number} {values} 1 {number:06d}.png\n\n")
    (folder / "results_txt" / "images.txt").write_text("".join(lines))
    return folder


def write_video(file: Path, pictures: list[np.ndarray]) -> None:
    """Write pictures (H, W, 3) uint8 as H.264."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, RATE_HZ)
        stream.options = {"crf": "20", "preset": "fast"}
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def write_clips(out: Path, frames: int) -> dict[str, Path]:
    """Render the clip and write it at both sizes; return the folders by what is in them."""
    calibration = out / "camera.xml"
    write_calibration(calibration, 1)
    spec = PhantomSpec(frames=frames, width=SIZE[0], height=SIZE[1], camera_file=calibration, seed=9, fps=RATE_HZ)
    phantom = prepare(spec)
    loop = [*range(frames), *range(frames - 2, 0, -1)]
    order = [loop[number % len(loop)] for number in range(LENGTH)]
    sources = {f"{SIZE[0] // scale}x{SIZE[1] // scale}": scale for scale in (1, _SCALED)}
    folders = {name: write_layout(out / name, phantom.poses[order], scale) for name, scale in sources.items()}
    if all(folder.with_suffix(".mp4").is_file() for folder in folders.values()):
        return folders
    pictures = []
    for index in range(frames):
        pictures.append(render_frame(phantom, index)[0])
        print(f"rendered {index + 1} of {frames}", end="\r", file=sys.stderr, flush=True)
    for name, scale in sources.items():
        size = (SIZE[0] // scale, SIZE[1] // scale)
        shown = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
        write_video(folders[name].with_suffix(".mp4"), [shown[index] for index in order])
    return folders


def row(name: str, source: Path, preset: str, out: Path) -> str:
    """Run a clip by a preset, export it, and return its line of the table."""
    result, submission = out / f"run-{name}-{preset}", out / f"submission-{name}-{preset}"
    command = [sys.executable, "-m", "scopemap"]
    given = ["--preset", preset, "--overwrite", "--no-resume", "--quiet"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*command, "run", str(source), "--out", str(result), *given], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    facts = json.loads((result / "provenance.json").read_text())
    seconds = facts["seconds"]
    parts = sorted(((part, s) for part, s in seconds.items() if part != "total"), key=lambda pair: -pair[1])[:6]
    most = ", ".join(f"{part} {1e3 * s / facts['frames']:.0f}" for part, s in parts)
    figures = climb_figures(read_trajectory(result), read_trajectory(source))
    export = ["climb", str(result), "--out", str(submission), "--clip", CLIP, "--json"]
    subprocess.run(["rm", "-rf", str(submission)], check=True)
    checked = subprocess.run([*command, *export], capture_output=True, text=True).stdout
    problems = json.loads(checked)["problems"]
    cells = (
        f"{facts['frames'] / seconds['total']:.1f}",
        f"{1e3 * processor_s / facts['frames']:.0f}",
        most,
        f"{facts['tracked']} of {facts['frames']}, {figures['submaps']:.0f}",
        f"{figures['ate_mean_mm']:.2f}",
        f"{figures['rpe_40_mean_deg']:.2f}",
        f"{figures['tfr_percent']:.0f}",
        "; ".join(problems) or "none",
    )
    return f"| {name} | {preset} | {' | '.join(cells)} |"


def main() -> None:
    """Render, run, export and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--presets", nargs="+", default=["default", "realtime"])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    folders = write_clips(options.out, options.frames)
    print(
        "| clip | preset | frames/s | processor ms a frame | ms a frame, parts | tracked, submaps that count | ATE mm ",
        end="",
    )
    print(
        "| rotation over 40 frames, deg | TFR % | faults of the submission |\n|---|---|---|---|---|---|---|---|---|---|"
    )
    for preset in options.presets:
        for name, folder in folders.items():
            print(row(name, folder, preset, options.out), flush=True)


if __name__ == "__main__":
    main()
