"""What was found on a surface, a lesion or blind spots, for others: markups of 3D Slicer, or a DICOM report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from scopemap.apps.export.slicer_markups import markup, write_markups
from scopemap.apps.measure.dicom_report import write_dicom_report
from scopemap.apps.measure.surface_finding import SurfaceFinding
from scopemap.engine.errors import reporting
from scopemap.report.reference_scale import holds_for, in_mm, reference_scale
from scopemap.result.result import Result

FINDING_ENDINGS = (".json", ".dcm")


def write_findings(run: Path, findings: list[SurfaceFinding], scale: str, file: Path) -> None:
    """Write findings on the surface of a run as markups (.json), or as a DICOM report (.dcm), which needs highdicom.

    scale : what their sizes rest on. Points are where the exported surface has them: in mm by the reference that was
    set by hand, where it gives the scale of that. Raises `InputError` where the file cannot be written,
    `SettingsError` where highdicom is not installed.
    """
    whole = Result(run).checked(with_poses=True)
    exported, known = in_mm(whole, whole.main_segment), reference_scale(whole)
    if known is not None and holds_for(known, whole, whole.main_segment):
        findings = [replace(one, points_mm=one.points_mm * known.factor) for one in findings]
    about = f"sizes: {scale}" + (f"; points, as the surface: {exported.scale}" if scale != exported.scale else "")
    with reporting(f"cannot write {file}"):
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix.lower() == ".dcm":
            write_dicom_report(exported, findings, about, file)
        else:
            write_markups(_markups_of(findings, about), file)


def _markups_of(findings: list[SurfaceFinding], about: str) -> list[dict[str, Any]]:
    """Return a list of the places, and a curve of each outline, open between two points.

    about : what sizes and points rest on.
    """
    places = {str(one): one.points_mm[0] for one in findings if len(one.points_mm) == 1}
    found = [markup("Fiducial", "findings", places, about)] if places else []
    for one in findings:
        if len(one.points_mm) > 1:
            points = {f"{one.name} {number}": at for number, at in enumerate(one.points_mm, start=1)}
            kind = "ClosedCurve" if len(one.points_mm) > 2 else "Curve"
            found.append(markup(kind, one.name, points, f"{one}; {about}"))
    return found
