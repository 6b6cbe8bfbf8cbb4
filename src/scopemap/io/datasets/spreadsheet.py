"""The first sheet of an Excel workbook (`.xlsx`), as a zip of XML; nothing is calculated."""

from __future__ import annotations

import lzma
import re
import zipfile
import zlib
from pathlib import Path
from xml.etree import ElementTree

from scopemap.errors import InputError

_SHEET, _STRINGS = "xl/worksheets/sheet1.xml", "xl/sharedStrings.xml"
# Some hundred thousand cells; as a tree they take many times as much.
_LARGEST_MEMBER_BYTES = 16 << 20
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, ElementTree.ParseError),
    *(OSError, EOFError, LookupError, RuntimeError, ValueError),
)


def read_sheet(file: Path) -> list[tuple[int, dict[str, str]]]:
    """Return the rows of the first sheet that hold anything: row number from 1, and the text of each cell by column.

    Columns are named as in Excel ("A", "B", ...); empty cells are left out. Raises `InputError` for any other file.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            if _SHEET not in names:
                raise InputError(f"reading {file}: this workbook has no first sheet ({_SHEET})")
            strings = _strings(_xml(archive, _STRINGS, file)) if _STRINGS in names else []
            rows = [_row(row, strings) for row in _xml(archive, _SHEET, file).iterfind("{*}sheetData/{*}row")]
    except _DAMAGE as error:
        raise InputError(f"reading {file}: no Excel workbook, or damaged ({error}); download it again") from None
    return [(number, cells) for number, cells in rows if cells]


def _xml(archive: zipfile.ZipFile, name: str, file: Path) -> ElementTree.Element:
    size = archive.getinfo(name).file_size
    if size > _LARGEST_MEMBER_BYTES:
        raise InputError(
            f"reading {file}: its {name} holds {size >> 20} MB, expected {_LARGEST_MEMBER_BYTES >> 20} at most"
        )
    return ElementTree.fromstring(archive.read(name))


def _strings(root: ElementTree.Element) -> list[str]:
    return [_text(item) for item in root.iterfind("{*}si")]


def _text(item: ElementTree.Element) -> str:
    """Return a text, which may be split into runs of different type."""
    return "".join(part.text or "" for part in item.iterfind(".//{*}t"))


def _row(row: ElementTree.Element, strings: list[str]) -> tuple[int, dict[str, str]]:
    cells: dict[str, str] = {}
    for cell in row.iterfind("{*}c"):
        column = re.match(r"[A-Z]+", cell.get("r", ""))
        if column is None:
            raise ValueError("a cell does not say where it stands")
        kind, value = cell.get("t", "n"), cell.findtext("{*}v") or ""
        text = _text(cell) if kind == "inlineStr" else value
        if kind == "s":
            text = strings[int(value)]
        if text.strip():
            cells[column[0]] = text.strip()
    return int(row.get("r", "")), cells
