"""Metashape's calibration XML (Agisoft Metashape User Manual, appendix "Camera models").

Its principal point counts from the middle of the picture, whose corner is (0, 0), and its p1 is OpenCV's p2.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from scopemap.input.camera_files.parsing import Fields, xml_root

_ADVICE = "export it from Metashape as OpenCV XML (Tools, Camera Calibration), or calibrate with a frame camera"
_FRAME = "frame"
_ADJUSTED = "adjusted"
_CORNER_TO_CENTRE_PX = 0.5
_OTHERS = ("k4", "p3", "p4")
_LENS = ("k1", "k2", "p2", "p1", "k3")


def metashape_fields(text: str) -> Fields | None:
    """Return the camera of a Metashape calibration as a mapping of ours, None for any other text.

    Raises `ValueError`, with the name, for its models that are no frame camera, and for coefficients without a place.
    """
    if "<projection>" not in text and "<sensor" not in text:
        return None
    root = xml_root(text)
    calibration = root if root.tag == "calibration" else _only(root.findall(".//sensor"))
    if calibration is None:
        return None
    model = (calibration.findtext("projection") or calibration.get("type") or "").strip()
    if model != _FRAME:
        raise ValueError(f"the lens model {model[:40]!r} of Metashape has no counterpart here: {_ADVICE}")
    if calibration.find("f") is None:
        raise ValueError(f"it has no f: it is of PhotoScan, whose conventions changed; {_ADVICE}")
    return _frame(calibration)


def _only(sensors: list[Element]) -> Element | None:
    """Return the calibration of the one sensor that has any: the adjusted one, where the initial one is beside it."""
    found = [calibrations for sensor in sensors if (calibrations := sensor.findall("calibration"))]
    if len(found) > 1:
        raise ValueError(f"it is Metashape's and holds {len(found)} cameras: leave the one of these images in it")
    calibrations = found[0] if found else []
    adjusted = [one for one in calibrations if one.get("class") == _ADJUSTED]
    return next(iter(adjusted or calibrations), None)


def _frame(calibration: Element) -> Fields:
    resolution = calibration.find("resolution")
    sides = resolution.attrib if resolution is not None else {}
    texts = {name: calibration.findtext(name) or sides.get(name) for name in ("width", "height")}
    size = Fields(texts.items())
    width, height = size.number(("width",)) or 0.0, size.number(("height",)) or 0.0
    if not width or not height:
        raise ValueError("it states no width and height, from whose middle its principal point counts")
    names = ("f", "cx", "cy", "b1", "b2", *_OTHERS, *_LENS)
    found = {name: Fields([(name, calibration.findtext(name) or "0")]).number((name,)) or 0.0 for name in names}
    if unused := [name for name in _OTHERS if found[name]]:
        raise ValueError(f"{unused[0]} of its Metashape lens has no place in OpenCV's: {_ADVICE}")
    cx, cy = (side / 2 + found[name] - _CORNER_TO_CENTRE_PX for side, name in ((width, "cx"), (height, "cy")))
    matrix = [found["f"] + found["b1"], found["b2"], cx, 0.0, found["f"], cy, 0.0, 0.0, 1.0]
    lens = [found[name] for name in _LENS]
    return Fields([("camera_matrix", matrix), ("D", lens), ("image_width", width), ("image_height", height)])
