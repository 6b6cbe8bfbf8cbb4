"""DICOM files made of pictures: native, packed frame by frame, MPEG."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.uid import MPEG4HP41, ExplicitVRLittleEndian, JPEGBaseline8Bit, generate_uid

from tests.support.drawn_inputs import picture, write_video

SIZE = (64, 48)
PATIENT = "Muster^Erika"


def dataset(syntax: str = ExplicitVRLittleEndian, **tags: Any) -> Dataset:
    """What every file holds, patient included."""
    found = Dataset()
    found.file_meta = FileMetaDataset()
    found.file_meta.TransferSyntaxUID = syntax
    found.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.77.1.1.1"
    found.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    found.SOPClassUID, found.SOPInstanceUID = (
        found.file_meta.MediaStorageSOPClassUID,
        found.file_meta.MediaStorageSOPInstanceUID,
    )
    found.PatientName, found.PatientID, found.Modality = PATIENT, "4711", "ES"
    found.Rows, found.Columns = SIZE[1], SIZE[0]
    found.SamplesPerPixel, found.PhotometricInterpretation, found.PlanarConfiguration = 3, "RGB", 0
    found.BitsAllocated, found.BitsStored, found.HighBit, found.PixelRepresentation = 8, 8, 7, 0
    for name, value in tags.items():
        setattr(found, name, value)
    return found


def save(found: Dataset, file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    found.save_as(file, enforce_file_format=True)
    return file


def native(file: Path, values: np.ndarray, syntax: str = ExplicitVRLittleEndian, **tags: Any) -> Path:
    """Write pictures (n, ...) as they are."""
    found = dataset(syntax, **{"NumberOfFrames": len(values)} | tags)
    found.PixelData = np.ascontiguousarray(values).tobytes() + b"\0" * (values.nbytes % 2)
    found["PixelData"].VR = "OW" if values.dtype.itemsize == 2 else "OB"
    return save(found, file)


def packed(file: Path, frames: list[bytes], syntax: str, **tags: Any) -> Path:
    """Write pictures that are packed already."""
    found = dataset(syntax, **{"NumberOfFrames": len(frames)} | tags)
    found.PixelData = encapsulate(frames)
    found["PixelData"].is_undefined_length = True
    return save(found, file)


def film(count: int = 4) -> np.ndarray:
    return np.stack([picture(number, SIZE) for number in range(count)])


def jpeg(rgb: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def write_frames(folder: Path) -> Path:
    frames = [jpeg(rgb) for rgb in film()]
    tags = {"PhotometricInterpretation": "YBR_FULL_422", "FrameTime": 40}
    return packed(folder / "clip.dcm", frames, JPEGBaseline8Bit, **tags)


def h264(container: str, count: int = 30, rate_hz: int = 30) -> bytes:
    """Return H.264 with pictures out of order, in a `container` or ("h264") bare."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format=container) as opened:
        stream = opened.add_stream("libx264", rate=rate_hz, options={"bf": "2"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for number in range(count):
            opened.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number, (160, 120)), format="rgb24")))
        opened.mux(stream.encode())
    return buffer.getvalue()


def write_dicom_video(folder: Path, pieces: int = 3, content: bytes = b"", **tags: Any) -> Path:
    """A video in several fragments; an MP4 of 25 pictures per second where there is no `content`."""
    folder.mkdir(parents=True, exist_ok=True)
    if not content:
        file = write_video(folder / "plain.mp4", 6)
        content = file.read_bytes()
        file.unlink()
    tags = {"NumberOfFrames": 6, "PhotometricInterpretation": "YBR_PARTIAL_420", "CineRate": 25} | tags
    found = dataset(MPEG4HP41, **tags)
    found.Rows, found.Columns = 120, 160
    length = -(-len(content) // pieces) // 2 * 2 + 2
    parts = [content[at : at + length] for at in range(0, len(content), length)]
    items = b"".join(b"\xfe\xff\x00\xe0" + len(p).to_bytes(4, "little") + p for p in [b"", *parts])
    found.PixelData = items + b"\xfe\xff\xdd\xe0" + bytes(4)
    found["PixelData"].is_undefined_length = True
    return save(found, folder / "video.dcm")
