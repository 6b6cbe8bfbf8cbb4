"""COLMAP (Schoenberger and Frahm, CVPR 2016) by pycolmap (BSD, extra `colmap`): incremental structure from motion.

Its own SIFT features, each frame matched with those around it in the video, the camera known and kept; the rest are
its defaults. It is given no depth: its scale is arbitrary. It is no tracker: every frame waits for all others.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.engine.masking.masker import Masker
from scopemap.input.mask_files import masks_of
from scopemap.input.sequence import Sequence
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.methods.imported import write_trajectory
from scopemap_bench.plan import MethodPlan


@dataclass(frozen=True)
class Colmap:
    """Reconstructs the masked frames; those that are in no model are lost, further models are submaps."""

    plan: MethodPlan

    def missing(self, settings: Mapping[str, Any]) -> str:
        """Return what to install where pycolmap is not there."""
        return "" if find_spec("pycolmap") else "needs pycolmap: pip install -c constraints.txt -e './bench[colmap]'"

    def run(self, sequence: Sequence, settings: Mapping[str, Any], out: Path) -> dict[str, float]:
        """Write the trajectory as a run's folder, and return its times; `InputError` where no model was found."""
        import pycolmap

        pycolmap.set_random_seed(0)
        config = Config.load(self.plan.preset, settings={**settings, **self.plan.settings})
        with TemporaryDirectory() as temporary:
            folder, times, cpu = Path(temporary), [time.perf_counter()], pycolmap.Device.cpu
            count = _write_frames(sequence, config, folder)
            database, images, c = folder / "database.db", folder / "images", sequence.camera
            # Its centre of the top-left pixel is (0.5, 0.5).
            camera = {"camera_model": "PINHOLE", "camera_params": f"{c.fx},{c.fy},{c.cx + 0.5},{c.cy + 0.5}"}
            reader = pycolmap.ImageReaderOptions(**camera, mask_path=folder / "masks")
            single = pycolmap.CameraMode.SINGLE
            pycolmap.extract_features(database, images, camera_mode=single, reader_options=reader, device=cpu)
            times.append(time.perf_counter())
            pycolmap.match_sequential(database, device=cpu)
            times.append(time.perf_counter())
            options = pycolmap.IncrementalPipelineOptions(ba_refine_focal_length=False)
            options.mapper.abs_pose_refine_focal_length = False
            models = pycolmap.incremental_mapping(database, images, folder, options).values()
            times.append(time.perf_counter())
            if not models:
                raise InputError(f"COLMAP found no model in the {count} frames of {sequence.path}")
            read = []
            for number, model in enumerate(sorted(models, key=lambda model: -model.num_reg_images())):
                text = folder / f"text{number}"
                text.mkdir()
                model.write_text(text)
                read.append(read_trajectory(text, kind="colmap"))
        by = f"COLMAP, pycolmap {pycolmap.__version__}"
        write_trajectory(replace(read[0], others=tuple(read[1:])), sequence, out, by)
        parts = dict(zip(("features", "matches", "mapping"), np.diff(times).tolist(), strict=True))
        spent = {f"seconds_{part}": seconds for part, seconds in parts.items()}
        return {"ms_per_frame": 1e3 * (times[-1] - times[0]) / count, **spent}


def _write_frames(sequence: Sequence, config: Config, folder: Path) -> int:
    """Write frames as NUMBER.png to images/ and their usable pixels to masks/ as COLMAP reads them; return how many."""
    masker = Masker(config.mask, masks_of(config.mask, sequence))
    for name in ("images", "masks"):
        (folder / name).mkdir()
    count = 0
    for frame in map(masker, sequence.frames()):
        name, count = f"{frame.index:06d}.png", count + 1
        cv2.imwrite(str(folder / "images" / name), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), frame.valid.astype("uint8") * 255)
    return count
