"""What a result in its folder can be asked in Python: what was not seen, how large something is, where a video is."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from scopemap.engine.errors import InputError

if TYPE_CHECKING:
    from scopemap.input.sequence import Sequence

_APPLICATIONS = {
    "coverage": "scopemap.apps.coverage.coverage",
    "measure": "scopemap.apps.measure.measure",
    "measure_lesion": "scopemap.apps.measure.lesion",
    "locate": "scopemap.apps.locate.locate",
}
"""By name, for a result imports no application."""


class ResultActions:
    """The questions to a result. `path` : its folder; None: it is in memory alone.

    Each raises `InputError` where the result is in memory alone, and where it cannot say.
    """

    path: Path | None

    def coverage(self) -> Any:
        """Return which share of the tissue no frame saw, and where, as `scopemap coverage` does.

        A `Coverage`: `total` and `segments` are shares with intervals of 90 %, `spots` the blind spots, the largest
        first, `map` the unrolled map; `print` shows it in words (docs/coverage.md).
        """
        return _application("coverage")(self._folder())

    def measure(
        self, frame: int, pixels: ArrayLike, reference: ArrayLike | None = None, reference_mm: float | None = None
    ) -> list[Any]:
        """Return distances between two pixels (2, 2) of a frame, or the area inside more, as `scopemap measure` does.

        Each is a `Measure` with `what`, `value`, `unit`, and `low` and `high`, the ends of its 95 % interval.
        reference : two pixels (2, 2) of the frame whose distance is the unit, or is `reference_mm` (docs/measure.md).
        """
        ends = None if reference is None else np.asarray(reference, float)
        found: list[Any] = _application("measure")(self._folder(), frame, np.asarray(pixels, float), ends, reference_mm)
        return found

    def measure_lesion(
        self,
        masks: Path | str | ArrayLike,
        frame: int | None = None,
        *,
        reference: ArrayLike | None = None,
        reference_frame: int | None = None,
        reference_mm: float | None = None,
    ) -> Any:
        """Return the sizes of a lesion from all frames together, as `scopemap measure --lesion` does.

        A `MeasuredLesion`: its `measures`, each a `Measure`, what their `scale` rests on, and its `masks` by frame.
        masks : a folder of pictures numbered as frames; or of one `frame` a picture, a mask (H, W) bool, or the corners
        (N, 2) of an outline, px. reference : as in `measure`, pixels of `reference_frame`, by default of `frame`.
        """
        shown = Path(masks) if isinstance(masks, Path | str) else np.asarray(masks)
        ends = None if reference is None else np.asarray(reference, float)
        known = {"reference": ends, "reference_frame": reference_frame, "reference_mm": reference_mm}
        return _application("measure_lesion")(self._folder(), shown, frame, **known)

    def locate(self, sequence: Sequence | Path | str) -> list[Any]:
        """Return where each frame of another video is in the map of this result, as `scopemap locate` does.

        Each is a `LocatedFrame` with its `status`, "found" or "not found", `T_world_camera` and `inliers`.
        sequence : from `open_sequence`; or the path of a video, which has the camera of this result's input where it
        has no calibration of its own (docs/locate.md).
        """
        return list(_application("locate")(self._folder(), sequence))

    def _folder(self) -> Path:
        if self.path is None:
            raise InputError("the result is in memory alone: give `reconstruct` a folder, out=, which keeps depth")
        return self.path


def _application(name: str) -> Callable[..., Any]:
    """Return what answers a question about a result's folder, its first argument."""
    found: Callable[..., Any] = getattr(import_module(_APPLICATIONS[name]), name)
    return found
