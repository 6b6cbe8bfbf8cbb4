"""The surface as a DICOM Encapsulated STL, into which no name, number or date of a patient is copied.

Sources: DICOM PS3.3, A.85.1 (Encapsulated STL IOD), C.35.1 (Manufacturing 3D Model); PS3.16, CID 7061 and 7063.
"""

from __future__ import annotations

from hashlib import sha256
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

from scopemap.apps.export.surfaces import Axes, stl_bytes
from scopemap.engine.errors import SettingsError
from scopemap.input.trajectory.trajectory import Unit
from scopemap.result.result import Result

_ENCAPSULATED_STL = "1.2.840.10008.5.1.4.1.1.104.3"
_NOBODY = "no name, number or date was copied from the input; research software, not a medical device"


def write_dicom_stl(run: Result, file: Path, unit: Unit, axes: Axes) -> None:
    """Write the surface as a binary STL in a DICOM file; raises as `dicom_stl`."""
    stream = BytesIO()
    dicom_stl(run, unit, axes).save_as(stream, enforce_file_format=True)
    file.write_bytes(stream.getvalue())


def dicom_stl(run: Result, unit: Unit, axes: Axes) -> Any:
    """Return the surface as a binary STL in a data set of pydicom: anonymous, and without a date.

    The unit of a surface of unknown scale is "no units", so that no viewer measures in it. Raises `SettingsError`
    where pydicom is not installed, `InputError` where the run has no surface.
    """
    try:
        from pydicom.uid import generate_uid
    except ModuleNotFoundError:
        raise SettingsError("writing DICOM needs pydicom: pip install -e '.[dicom]'") from None
    content = stl_bytes(run, unit, axes)
    data = _dataset(run, {"mm": ("mm", "mm"), "m": ("m", "m")}[unit] if run.scale_known else ("1", "no units"))
    # The same surface is the same instance; its identifiers say nothing about where it comes from.
    for keyword in ("SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
        setattr(data, keyword, generate_uid(entropy_srcs=[keyword, sha256(content).hexdigest()]))
    data.EncapsulatedDocument = content + b"\0" * (len(content) % 2)
    data.EncapsulatedDocumentLength = len(content)
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID
    return data


def _dataset(run: Result, unit: tuple[str, str]) -> Any:
    """Return what the modules of the IOD require, without identifiers and document."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.sr.codedict import codes
    from pydicom.uid import UID, ExplicitVRLittleEndian

    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = UID(_ENCAPSULATED_STL)
    # Required, and empty: nobody is named.
    for keyword in ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime"):
        setattr(data, keyword, "")
    for keyword in ("ReferringPhysicianName", "StudyID", "AccessionNumber", "AcquisitionDateTime"):
        setattr(data, keyword, "")
    for keyword in ("ContentDate", "ContentTime", "PositionReferenceIndicator"):
        setattr(data, keyword, "")
    data.PatientIdentityRemoved = "YES"
    data.DeidentificationMethod = "nothing copied from the input's tags; not checked further"
    data.Modality, data.SeriesNumber, data.InstanceNumber = "M3D", 1, 1
    data.SeriesDescription = "surface from an endoscope's video"
    data.Manufacturer = data.ManufacturerModelName = "scopemap"
    data.DeviceSerialNumber, data.SoftwareVersions = "none", version("scopemap")
    data.BurnedInAnnotation, data.DocumentTitle = "NO", "surface, research only"
    known = "scale as stated" if (run.provenance.get("scale") or {}).get("stated") else "scale known"
    data.ContentDescription = known if run.scale_known else "scale unknown: do not measure"
    data.ImageComments = f"{_NOBODY}; {run.scale}"
    data.MIMETypeOfEncapsulatedDocument = "model/stl"
    data.ConceptNameCodeSequence = [_code(codes.DCM.PhotogrammetricImaging3DCAMModel)]
    data.MeasurementUnitsCodeSequence = [_code((unit[0], "UCUM", unit[1]))]
    data.ModelModification, data.ModelMirroring = "NO", "NO"
    return data


def _code(code: Any) -> Any:
    from pydicom.dataset import Dataset

    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = tuple(code)[:3]
    return item
