"""Lesions and blind spots for 3D Slicer, and as a DICOM report, read back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scopemap.apps.measure.findings import write_findings
from scopemap.apps.measure.measure import Measure
from scopemap.apps.measure.surface_finding import SurfaceFinding
from tests.apps.measure.test_lesion import RADIUS
from tests.support.drawn_run import draw_run
from tests.support.front_door import call, refused

OUTLINE = "30,44 40,48 50,44 40,40"
SPOT = SurfaceFinding("blind spot 1", np.array([[1.0, 2, 3]]), [Measure("area not seen", 7.0, np.nan, np.nan, "unit2")])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scale = {"known": True, "measured": True, "source": "measured depth"}
    return draw_run(tmp_path_factory.mktemp("findings") / "run", scale=scale)


def test_a_lesion_is_a_closed_curve_on_the_surface(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "lesion.mrk.json"
    assert call("measure", run, "--lesion", OUTLINE, "--frame", 2, "--export", file) == 0
    [curve] = json.loads(file.read_text())["markups"]
    assert (curve["type"], curve["coordinateSystem"], curve["coordinateUnits"]) == ("ClosedCurve", "LPS", "mm")
    assert "largest diameter: " in curve["description"]
    assert "measured depth" in curve["description"]
    points = np.array([point["position"] for point in curve["controlPoints"]])
    assert len(points) > 20
    # The tube's wall, all around the lesion.
    assert np.hypot(points[:, 0], points[:, 1]) == pytest.approx(np.full(len(points), RADIUS), abs=0.1)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < np.ptp(points, axis=0).max() / 3


def test_blind_spots_are_labelled_points(run: Path, tmp_path: Path) -> None:
    write_findings(run, [SPOT, SPOT], "the scale's words", tmp_path / "spots.mrk.json")
    [points] = json.loads((tmp_path / "spots.mrk.json").read_text())["markups"]
    assert (points["type"], points["display"]["pointLabelsVisibility"]) == ("Fiducial", True)
    [point] = points["controlPoints"][:1]
    assert (point["label"], point["position"]) == ("blind spot 1: area not seen: 7 unit2", [1.0, 2.0, 3.0])
    assert "the scale's words" in points["description"]


def test_a_report_is_read_back(run: Path, tmp_path: Path) -> None:
    highdicom, dcmread = pytest.importorskip("highdicom"), pytest.importorskip("pydicom").dcmread
    lesion, surface = tmp_path / "lesion.dcm", tmp_path / "surface.dcm"
    assert call("measure", run, "--lesion", OUTLINE, "--frame", 2, "--export", lesion) == 0
    assert call("export", run, "--to", "dicom", "--out", surface) == 0
    report = highdicom.sr.srread(lesion)
    assert (str(report.PatientName), report.PatientIdentityRemoved) == ("", "YES")
    [group] = report.content.get_planar_roi_measurement_groups()
    # Of the surface that `export --to dicom` writes.
    uid = report.CurrentRequestedProcedureEvidenceSequence[0].ReferencedSeriesSequence[0].ReferencedSOPSequence[0]
    stored = dcmread(surface)
    assert uid.ReferencedSOPInstanceUID == stored.SOPInstanceUID
    assert group.roi.frame_of_reference_uid == stored.FrameOfReferenceUID
    assert np.array_equal(group.roi.value[0], group.roi.value[-1])
    sizes = {one.name.meaning: (one.value, one.unit.value) for one in group.get_measurements()}
    assert set(sizes) == {"Long Axis", "Short Axis", "Length", "Area", "Height"}
    assert (sizes["Long Axis"][1], sizes["Area"][1]) == ("mm", "mm2")
    write_findings(run, [SPOT], "a guess", tmp_path / "spots.dcm")
    [group] = highdicom.sr.srread(tmp_path / "spots.dcm").content.get_planar_roi_measurement_groups()
    [size] = group.get_measurements()
    assert (size.value, size.unit.meaning, group.roi.value.tolist()) == (7.0, "no units", [[1.0, 2.0, 3.0]])


def test_what_cannot_be_written_is_refused(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ("measure", run, "--lesion", OUTLINE, "--frame", 2, "--export")
    assert "must end in .json or .dcm" in refused(capfd, *words, tmp_path / "lesion.txt")
    assert call("measure", run, "--points", OUTLINE, "--frame", 2, "--export", tmp_path / "a.dcm") == 2
