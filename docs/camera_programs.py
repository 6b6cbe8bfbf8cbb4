"""The table of programs whose camera files are read, docs/calibrate.md: `python docs/camera_programs.py` writes it."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from scopemap.input.camera_files.programs import NOT_READ, OTHERS, PROGRAMS

PAGE = Path(__file__).with_name("calibrate.md")
_BEGIN = "<!-- by docs/camera_programs.py -->\n"
_END = "<!-- end -->\n"


def programs_page(page: str) -> str:
    """Return the text of docs/calibrate.md with its list of programs as the code has it."""
    before, _, rest = page.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    return f"{before}{_BEGIN}{_table()}{_END}{after}"


def _table() -> str:
    """Return the rows of the table, those of one program together, and what is not read."""
    rows = [*OTHERS, *((one.name, one.told_by, one.lenses_read) for one in PROGRAMS)]
    rows.sort(key=lambda row: row[0].lower())
    parts = ["| program | files | lenses |\n|---|---|---|\n"]
    for name, of_one in groupby(rows, key=lambda row: row[0]):
        _, files, lenses = zip(*of_one, strict=True)
        parts.append(f"| {name} | {'; '.join(dict.fromkeys(files))} | {', '.join(dict.fromkeys(lenses))} |\n")
    parts.append("\nThese files are not read. The error says what to do instead:\n\n")
    parts += [f"- {words.partition(';')[0]}\n" for _, words in NOT_READ]
    return "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(programs_page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
