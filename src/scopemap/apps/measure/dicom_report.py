"""Findings on a surface as a DICOM Comprehensive 3D SR by highdicom, anonymous, in the frame of reference of the STL.

Sources: DICOM PS3.16, TID 1500 (Measurement Report), TID 1410 (Planar ROI), TID 310 (uncertainty of a measurement).
It refers to the surface as `export --to dicom` writes it; where that is filed, both belong to one study.
"""

from __future__ import annotations

from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.apps.export.dicom_stl import dicom_stl
from scopemap.apps.measure.measure import Measure
from scopemap.apps.measure.surface_finding import SurfaceFinding
from scopemap.engine.errors import SettingsError
from scopemap.result.result import Result

_UNITS = {"mm": ("mm", "UCUM", "mm"), "mm2": ("mm2", "UCUM", "mm2")}
_NO_UNITS = ("1", "UCUM", "no units")
_NAMES = {
    "straight": ("121206", "DCM", "Distance"),
    "largest diameter": ("103339001", "SCT", "Long Axis"),
    "diameter across it": ("103340004", "SCT", "Short Axis"),
    "along the surface": ("410668003", "SCT", "Length"),
    "area": ("42798000", "SCT", "Area"),
    "area not seen": ("42798000", "SCT", "Area"),
    "height": ("121207", "DCM", "Height"),
}
_ENDOSCOPY = ("423827005", "SCT", "Endoscopy")
_ONLY_RESEARCH = "research software, not a medical device; intervals hold 95 %"


def write_dicom_report(run: Result, findings: list[SurfaceFinding], about_scale: str, file: Path) -> None:
    """Write findings with their sizes and intervals; about_scale : what these, and the points, rest on.

    Raises `SettingsError` where highdicom is not installed, `InputError` where the run has no surface.
    """
    try:
        from highdicom import UID, sr
    except ModuleNotFoundError:
        raise SettingsError("a DICOM report needs highdicom: pip install -e '.[dicom]'") from None
    surface = dicom_stl(run, "mm", "lps")
    device = sr.DeviceObserverIdentifyingAttributes(uid=UID(), name="scopemap")
    context = sr.ObservationContext(sr.ObserverContext(sr.CodedConcept("121007", "DCM", "Device"), device))
    about = sr.AlgorithmIdentification("scopemap", version("scopemap"), [about_scale, _ONLY_RESEARCH])
    groups = [
        sr.PlanarROIMeasurementsAndQualitativeEvaluations(
            tracking_identifier=sr.TrackingIdentifier(UID(), one.name),
            referenced_region=sr.ImageRegion3D(*_shape(one.points_mm), surface.FrameOfReferenceUID),
            algorithm_id=about,
            measurements=[_measurement(sr, size) for size in one.sizes],
        )
        for one in findings
    ]
    report = sr.MeasurementReport(context, sr.CodedConcept(*_ENDOSCOPY), groups)
    document = sr.Comprehensive3DSR([surface], report, UID(), 2, UID(), 1, "scopemap", is_complete=True)
    stream = BytesIO()
    document.save_as(stream, enforce_file_format=True)
    file.write_bytes(stream.getvalue())


def _shape(points_mm: np.ndarray) -> tuple[str, np.ndarray]:
    """Return a point, a line between two, or a closed line around more: a polygon of DICOM is flat."""
    if len(points_mm) < 3:
        return ("POINT", "POLYLINE")[len(points_mm) - 1], points_mm
    return "POLYLINE", np.concatenate([points_mm, points_mm[:1]])


def _measurement(sr: Any, size: Measure) -> Any:
    unit, name = sr.CodedConcept(*_UNITS.get(size.unit, _NO_UNITS)), sr.CodedConcept(*_NAMES[size.what])
    if not np.isfinite([size.low, size.high]).all():
        return sr.Measurement(name, size.value, unit)
    interval = sr.MeasurementProperties(
        upper_measurement_uncertainty=size.high - size.value, lower_measurement_uncertainty=size.value - size.low
    )
    for item in interval:  # to highdicom they have no unit
        item.MeasuredValueSequence[0].MeasurementUnitsCodeSequence = [unit]
    return sr.Measurement(name, size.value, unit, properties=interval)
