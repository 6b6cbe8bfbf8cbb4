"""Kalibr's camchain (github.com/ethz-asl/kalibr, wiki "yaml formats"): cameras cam0, cam1, ..., of which cam0 is used.

EuRoC's sensor.yaml is one camera of it, with other words for the same.
"""

from __future__ import annotations

import re

from scopemap.cameras.formats.fields import Fields
from scopemap.cameras.formats.lens_models import with_lens
from scopemap.cameras.formats.opencv import depth_scale_mm
from scopemap.cameras.formats.sizes import size_of
from scopemap.cameras.formats.stated import Calibration, Size, pinhole_of
from scopemap.cameras.formats.trees import Repeated, Tree

_CAMERA = re.compile(r"cam\d{1,3}")
_LENSES = {"radtan": 4, "radial tangential": 4, "equidistant": 4, "equi": 4, "fov": 1, "none": 0, "": 0}
_COEFFICIENTS = ("distortion_coeffs", "distortion_coefficients")


def cameras_in(tree: Tree) -> dict[str, Tree]:
    """Return the cameras of a chain by name; of EuRoC's sensor.yaml the one; empty where the tree is neither."""
    if isinstance(tree.get("intrinsics"), list) and "camera_model" in tree:
        return {"the camera": tree}
    named = {name: node for name, node in tree.items() if _CAMERA.fullmatch(name)}
    for name in (name for name, node in named.items() if isinstance(node, Repeated)):
        raise ValueError(f"{name!r} stands in it twice: leave one out")
    found = {name: node for name, node in named.items() if isinstance(node, dict)}
    return {name: node for name, node in found.items() if "intrinsics" in node}


def of_chain(tree: Tree, cameras: dict[str, Tree], image_size: Size) -> Calibration:
    """Return the first camera of a chain; `ValueError` for models that have no counterpart here, and wrong counts."""
    name = "cam0" if "cam0" in cameras else min(cameras)
    camera = Fields(cameras[name])
    model, lens = camera.words(("camera_model",)), camera.words(("distortion_model",))
    if model != "pinhole":
        raise ValueError(
            f"{name} is of Kalibr's camera model {model[:40]!r}, which has no counterpart here: calibrate with "
            "pinhole-equi or pinhole-radtan"
        )
    if lens not in _LENSES:
        raise ValueError(f"{name} has Kalibr's distortion model {lens[:40]!r}, expected one of {', '.join(_LENSES)}")
    intrinsics, coefficients = camera.numbers(("intrinsics",)) or [], camera.numbers(_COEFFICIENTS) or []
    if len(intrinsics) != 4 or len(coefficients) != _LENSES[lens]:
        raise ValueError(
            f"{name} has {len(intrinsics)} intrinsics and {len(coefficients)} distortion_coeffs, expected fu fv pu pv "
            f"and {_LENSES[lens]}"
        )
    size, size_note = size_of([camera], intrinsics, image_size)
    pinhole, origin = pinhole_of(intrinsics, size, image_size)
    note = f", {name} of {len(cameras)} cameras" if len(cameras) > 1 else ""
    model_camera, lens_note = with_lens(pinhole, lens, coefficients)
    return Calibration(model_camera, depth_scale_mm([camera, Fields(tree)]), note + size_note + lens_note, origin)
