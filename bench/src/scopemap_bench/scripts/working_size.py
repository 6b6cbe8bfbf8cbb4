"""Processor time per frame against the working size: `python -m scopemap_bench.scripts.working_size CLIP [--frames N]`.

The clip is shown at four sizes from 160x128 to 1280x1024, made from its own pictures, and reconstructed at each with
everything that a default run does but the focal length, whose cost does not grow. A line, a + b times the pixels, is
fitted; the last column is the measured time over it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from scopemap import Config, open_sequence, reconstruct

SIZES = ((160, 128), (320, 256), (640, 512), (1280, 1024))


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path, help="video or folder of frames")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--preset", default="default")
    options = parser.parse_args()
    config = Config.load(options.preset, settings={"input.focal": "assume"})
    with tempfile.TemporaryDirectory() as folder:
        _write_large(options.clip, Path(folder) / "clip", options.frames)
        for _ in range(2):  # kernels are compiled, or read from their cache, in the first of these
            first = _ms_per_frame(Path(folder), SIZES[0], config)
        times = [first, *(_ms_per_frame(Path(folder), size, config) for size in SIZES[1:])]
    pixels = np.array([width * height for width, height in SIZES], float)
    # Relative errors count, so that small sizes weigh as much as large ones.
    law = np.column_stack([np.ones(len(pixels)), pixels]) / np.array(times)[:, None]
    line = np.linalg.lstsq(law, np.ones(len(pixels)), rcond=None)[0]
    print(f"{'size':>10} {'ms per frame':>13} {'over the line':>14}")
    for (width, height), ms in zip(SIZES, times, strict=True):
        print(f"{f'{width}x{height}':>10} {ms:13.1f} {ms / (line[0] + line[1] * width * height):14.2f}")
    print(f"line: {line[0]:.1f} ms + {1e6 * line[1]:.0f} ms per megapixel; processor time, {options.frames} frames")


def _write_large(clip: Path, folder: Path, count: int) -> None:
    folder.mkdir()
    for number, frame in enumerate(islice(open_sequence(clip).frames(), count)):
        large = cv2.resize(frame.rgb, SIZES[-1], interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number:04d}.png"), large[..., ::-1])


def _ms_per_frame(folder: Path, size: tuple[int, int], config: Config) -> float:
    sequence = open_sequence(folder / "clip", size=size)
    started = time.process_time()
    result = reconstruct(sequence, config, out=folder / "result", overwrite=True)
    return 1e3 * (time.process_time() - started) / len(result.frames)


if __name__ == "__main__":
    main()
