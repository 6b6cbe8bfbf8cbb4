"""The first sheet of an Excel workbook (`.xlsx`), read by the package `openpyxl` (the extra `datasets`)."""

from __future__ import annotations

import zipfile
from importlib.util import find_spec
from pathlib import Path

from scopemap.errors import InputError
from scopemap.io.decoding import check_bytes, reporting

# Some hundred thousand cells; in memory they take many times as much.
_MOST_BYTES, _MOST_CELLS = 32 << 20, 4_000_000


def read_sheet(file: Path) -> list[tuple[int, list[str]]]:
    """Return the rows of the first sheet that hold anything: row number from 1, and the text of each cell, "" if empty.

    Raises `InputError` for any other file, for one that unpacks to more than 32 MB, and without `openpyxl`.
    """
    if find_spec("openpyxl") is None:
        raise InputError(f"reading {file}: it is a spreadsheet; install its reader: pip install 'scopemap[datasets]'")
    import openpyxl

    with reporting(f"reading {file}: no Excel workbook, or damaged; download it again"):
        with zipfile.ZipFile(file) as archive:
            check_bytes(str(file), sum(member.file_size for member in archive.infolist()), _MOST_BYTES)
        sheet = openpyxl.load_workbook(file, data_only=True).worksheets[0]
        if sheet.max_row * sheet.max_column > _MOST_CELLS:
            raise InputError(f"reading {file}: its first sheet claims {sheet.max_row}x{sheet.max_column} cells")
        rows = [["" if cell is None else str(cell).strip() for cell in row] for row in sheet.values]
    return [(number, row) for number, row in enumerate(rows, start=1) if any(row)]
