"""The content of a calibration file, up to a size that no calibration exceeds."""

from __future__ import annotations

from pathlib import Path

from scopemap.errors import CalibrationError

_MOST_BYTES = 1 << 20


def calibration_bytes(file: Path) -> bytes:
    """Return what the file holds; `CalibrationError` where it cannot be read or is larger than 1 MiB."""
    try:
        if not file.is_file():  # a pipe would be waited for
            raise OSError("there is no such file" if not file.exists() else "it is no file")
        with file.open("rb") as opened:
            content = opened.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None
    if len(content) > _MOST_BYTES:
        raise CalibrationError(f"the calibration {file} is larger than any calibration: more than {_MOST_BYTES} bytes")
    return content


def calibration_text(file: Path) -> str:
    """Return the file's text, UTF-8; `CalibrationError` as for its bytes, and where it is no text.

    Bytes that are no UTF-8, as in comments of any tool, become question marks.
    """
    content = calibration_bytes(file)
    if b"\0" in content:
        raise CalibrationError(f"cannot read the calibration in {file}: it is binary, not text")
    return content.decode("utf-8-sig", errors="replace")
