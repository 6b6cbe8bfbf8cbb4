"""The page and the table of a batch: what became of each of many videos."""

from __future__ import annotations

import csv
import html
import io
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from scopemap.engine.errors import reporting
from scopemap.report.page import PAGE
from scopemap.result.result_folder import SUMMARY_PICTURE
from scopemap.result.wording import LEVEL_WORDS

_COLUMNS = ("input", "folder", "status", "reason", "seconds", "frames", "tracked", "verdict")
_ORDER = ("failed", "started", "done", "waiting")
_LEVELS = {word: level for level, word in LEVEL_WORDS.items()}


@dataclass(frozen=True)
class BatchRow:
    """What became of a video of a batch.

    status : waiting, started, done or failed, with the reason. seconds : of all attempts. frames, tracked : those used,
    and those in the result. verdict, sentence : of its report. key : of its input and settings. before : when an older
    result in its folder was written, ns since 1970; None where there was none.
    """

    input: str
    folder: str
    status: str = "waiting"
    reason: str = ""
    seconds: float = 0.0
    frames: int = 0
    tracked: int = 0
    verdict: str = ""
    sentence: str = ""
    key: str = ""
    before: int | None = None


def write_batch_table(rows: Sequence[BatchRow], file: Path) -> None:
    """Write one line of CSV for each row. Raises `InputError` where the file cannot be written."""
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, _COLUMNS, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(asdict(row) | {"seconds": f"{row.seconds:.1f}"} for row in rows)
    write_at_once(file, table.getvalue())


def write_batch_page(rows: Sequence[BatchRow], file: Path) -> None:
    """Write a page that shows each row with its picture, failures first, and links to its report beside the page.

    It asks no network for anything. Raises `InputError` where the file cannot be written.
    """
    shown = sorted(rows, key=lambda row: _ORDER.index(row.status))
    page = (files("scopemap.report") / "assets" / "batch.html").read_text(encoding="utf-8")
    page = page.replace("{{counts}}", html.escape(counts_of(rows)))
    write_at_once(file, page.replace("{{rows}}", "\n".join(map(_card, shown))))


def write_at_once(file: Path, text: str) -> None:
    """Write a text so that whoever reads the file meanwhile finds the old or the new one, whole.

    Raises `InputError` where the file cannot be written.
    """
    with reporting(f"cannot write {file}"):
        draft = file.with_name(f".{file.name}.{os.getpid()}")
        draft.write_bytes(text.encode("utf-8", "replace"))
        draft.replace(file)


def counts_of(rows: Sequence[BatchRow]) -> str:
    """Return how many rows have which status, and which verdict, in one line."""
    statuses, verdicts = Counter(row.status for row in rows), Counter(row.verdict for row in rows if row.verdict)
    counted = ", ".join(f"{statuses[status]} {status}" for status in reversed(_ORDER) if statuses[status])
    judged = ", ".join(f"{verdicts[word]} {word}" for word in LEVEL_WORDS.values() if verdicts[word])
    return f"{len(rows)} video{'s' * (len(rows) != 1)}: {counted}" + (f" ({judged})" if judged else "")


def _card(row: BatchRow) -> str:
    """Return a row as HTML."""
    name, level = html.escape(row.folder), _LEVELS.get(row.verdict, "bad" if row.status == "failed" else "note")
    word = html.escape(row.verdict or row.status)
    facts = html.escape(row.sentence or row.reason)
    small = f"{html.escape(row.input)} · {row.seconds:.0f} s"
    text = f'<h2>{name}</h2><p class="word">{word}</p><p>{facts}</p><p class="small">{small}</p>'
    if row.status != "done":
        return f'<li class="{level}"><div>{text}</div></li>'
    folder = quote(row.folder, errors="replace")
    picture = f'<img src="{folder}/{SUMMARY_PICTURE}" alt="" loading="lazy">'
    return f'<li class="{level}"><a href="{folder}/{PAGE}">{picture}<div>{text}</div></a></li>'
