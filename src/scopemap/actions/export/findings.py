"""What was found on a surface, a lesion or blind spots, for others: markups of 3D Slicer, or a DICOM report."""

from __future__ import annotations

from pathlib import Path

from scopemap.actions.export.dicom_report import write_dicom_report
from scopemap.actions.export.exported_run import read_exported
from scopemap.actions.export.markups import SurfaceFinding, markups_of, write_markups
from scopemap.errors import reporting

FINDING_ENDINGS = (".json", ".dcm")


def write_findings(run: Path, findings: list[SurfaceFinding], scale: str, file: Path) -> None:
    """Write findings on the surface of a run as markups (.json), or as a DICOM report (.dcm), which needs highdicom.

    scale : what their sizes rest on. Raises `InputError` where the file cannot be written, `SettingsError` where
    highdicom is not installed.
    """
    exported = read_exported(run)
    about = f"sizes: {scale}" + (f"; points, as the surface: {exported.scale}" if scale != exported.scale else "")
    with reporting(f"cannot write {file}"):
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix.lower() == ".dcm":
            write_dicom_report(exported, findings, about, file)
        else:
            write_markups(markups_of(findings, about), file)
