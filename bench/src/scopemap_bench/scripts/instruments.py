"""How well instruments are found: IoU where the truth is known, and what is masked where there are none.

    python -m scopemap_bench.scripts.instruments --data FOLDER [--scenes FOLDER] [--model FILE] [--pictures FOLDER]
                                     [--only NAME ...]

FOLDER is the real data's (README, "Tests on real data"). Frames are masked as a run masks them, without any file.
Rendered pictures are those of `training.instruments`, whose held-out scenes are rendered into `--scenes`; without it
they are left out. `--pictures` draws some frames of each clip with their masks.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scopemap import open_sequence
from scopemap.config import MaskSettings
from scopemap.depth.scopenet import estimator
from scopemap.depth.scopenet.estimator import ScopeNetDepth
from scopemap.masking.mask_files import MaskFiles
from scopemap.masking.masker import Masker

sys.path.insert(0, str(Path(__file__).resolve().parents[4]))

_SHIPPED = Path(estimator.__file__).parent / estimator.WEIGHTS_NAME
_HEADER = (
    "| clip | frames | masked % | most % | frames with > 0.5 % | IoU | median IoU of frames | truth found |\n"
    "|---|---|---|---|---|---|---|---|"
)
_PHANTOMS = ("colon", "laparoscopy", "tube")
_PICTURES = 12


@dataclass
class Found:
    """What was masked on a clip: shares of the frames, and against the truth, both as found and with their rim."""

    shares: list[float]
    ious: list[float]
    both: int = 0
    either: int = 0
    true: int = 0
    seconds: float = 0.0

    def row(self, name: str) -> str:
        """Return the row of the table."""
        shares = np.array(self.shares)
        cells = [name, str(len(shares)), f"{100 * shares.mean():.2f}", f"{100 * shares.max():.1f}"]
        cells.append(f"{100 * (shares > 0.005).mean():.0f}")
        if self.either:
            cells += [f"{self.both / self.either:.3f}", f"{np.median(self.ious):.3f}", f"{self.both / self.true:.3f}"]
        else:
            cells += [""] * 3
        return f"| {' | '.join(cells)} |"


def measure(source: Path, model: str, truth: Path | None, pictures: Path | None) -> Found:
    """Mask the frames of a source as a run does, and compare with masks of the truth where there are some."""
    sequence = open_sequence(source)
    masker, network = Masker(MaskSettings(instruments="auto")), ScopeNetDepth(model, rays_known=sequence.calibrated)
    files = None if truth is None else MaskFiles(truth, sequence.rectifier)
    found, drawn = Found([], []), []
    for frame in sequence.frames():
        seen = masker(frame)
        began = time.perf_counter()
        mask = masker.instruments(network.estimate(seen).instruments)
        found.seconds += time.perf_counter() - began
        assert mask is not None
        found.shares.append(float(mask.mean()))
        true = None if files is None else files.covered(frame.index)
        if true is not None:
            both, either = np.count_nonzero(mask & true), np.count_nonzero(mask | true)
            found.both, found.either, found.true = found.both + both, found.either + either, found.true + true.sum()
            found.ious.append(both / max(either, 1))
        drawn.append((frame.rgb, mask))
    if pictures is not None:
        _draw(drawn, pictures / f"{source.stem}.jpg")
    return found


def _draw(drawn: list[tuple[np.ndarray, np.ndarray]], file: Path) -> None:
    """Draw frames spread over a clip, instruments in green."""
    some = [drawn[n] for n in np.linspace(0, len(drawn) - 1, min(_PICTURES, len(drawn))).astype(int)]
    tinted = [np.where(mask[..., None], rgb // 2 + np.array([0, 127, 0], np.uint8), rgb) for rgb, mask in some]
    rows = [np.hstack(tinted[n : n + 4]) for n in range(0, len(tinted) - len(tinted) % 4, 4)]
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.vstack(rows)[..., ::-1])


def clips(data: Path, phantoms: Path) -> dict[str, tuple[Path, Path | None]]:
    """Return the clips by name, each with the masks of its truth; phantoms are rendered where they are missing."""
    endoscopy = data / "endoscopy"
    pulling = endoscopy / "endonerf" / "pulling_soft_tissues"
    found: dict[str, tuple[Path, Path | None]] = {
        "pulling_soft_tissues": (pulling, pulling / "gt_masks"),
        "laparoscopy_rvim": (endoscopy / "video" / "laparoscopy_rvim.mp4", None),
        "cecum_t1_a": (endoscopy / "c3vd" / "cecum_t1_a", None),
        "trans_t1_a": (endoscopy / "c3vd" / "trans_t1_a", None),
        "colonoscopy_nflba_03": (endoscopy / "video" / "colonoscopy_nflba_03.mp4", None),
    }
    for scene in _PHANTOMS:
        folder = phantoms / scene
        if not (folder / "mesh_truth.ply").is_file():
            command = [sys.executable, "-m", "scopemap", "phantom", str(folder), "--scene", scene, "--frames", "30"]
            subprocess.run([*command, "--seed", "11", "--quiet"], check=True)
        found[f"phantom {scene}"] = (folder, None)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--model", default="", help="a network, instead of the one of the package")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    options = parser.parse_args()
    print(_HEADER)
    with tempfile.TemporaryDirectory() as folder:
        for name, (source, truth) in clips(options.data, Path(folder)).items():
            if not options.only or name in options.only:
                print(measure(source, options.model, truth, options.pictures).row(name), flush=True)
    if options.scenes is not None:
        # Torch is not needed for the clips.
        from training.export import read_network
        from training.instrument_training import Recipe, figures, rendered

        recipe = Recipe.read(Path(__file__).resolve().parents[4] / "training" / "instruments_finish.toml")
        held_out = rendered(recipe, options.scenes, 1, lambda text: None, "held-out")
        print("\n| rendered, held out | |\n|---|---|")
        for name, value in figures(read_network(Path(options.model or _SHIPPED)), *held_out, recipe).items():
            print(f"| {name} | {value:.4f} |")


if __name__ == "__main__":
    main()
