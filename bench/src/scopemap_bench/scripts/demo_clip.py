"""Writes the clip that `scopemap demo` reconstructs, 60 frames of the phantom colon, with its truth into the core
package.

    python -m scopemap_bench.scripts.demo_clip [--out FOLDER]
"""

from __future__ import annotations

import shutil
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import cv2

import scopemap
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from scopemap_bench.scripts.measuring import options_of

SPEC = PhantomSpec(scene="colon", frames=60, width=320, height=256, seed=0)
_OPTIONS = {"crf": "18", "preset": "slow"}


def write_clip(out: Path, spec: PhantomSpec = SPEC) -> None:
    """Render the phantom and write its frames as a video, with its camera and its true poses."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        phantom = Path(scratch)
        write_phantom(spec, phantom)
        for name in ("camera.yaml", "pose.txt"):
            shutil.copyfile(phantom / name, out / name)
        with av.open(str(out / "colon.mp4"), "w") as video:
            stream = video.add_stream("libx264", rate=Fraction(round(spec.fps)), options=_OPTIONS)
            stream.width, stream.height, stream.pix_fmt = spec.width, spec.height, "yuv420p"
            stream.codec_context.thread_count = 1
            for file in sorted(phantom.glob("*_color.png")):
                frame = av.VideoFrame.from_ndarray(cv2.imread(str(file)), format="bgr24")
                video.mux(stream.encode(frame))
            video.mux(stream.encode())


def main() -> None:
    """Write the clip."""
    parser = options_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path(scopemap.__file__).parent / "apps" / "demo" / "clip")
    write_clip(parser.parse_args().out)


if __name__ == "__main__":
    main()
