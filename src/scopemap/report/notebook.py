"""How a `Result` shows itself: in one line with its verdict, and in a notebook by its summary picture."""

from __future__ import annotations

import html
from base64 import b64encode
from io import BytesIO

from scopemap.report.facts import report_facts
from scopemap.report.summary_picture import summary_picture
from scopemap.result.result import Result
from scopemap.result.verdict import verdict


def in_one_line(result: Result) -> str:
    """Return the verdict and the main facts."""
    found = verdict(result)
    return f"<Result, {found.word}: {found.sentence}>"


def as_html(result: Result) -> str:
    """Return the summary picture."""
    file, words = BytesIO(), html.escape(in_one_line(result))
    summary_picture(report_facts(result)).save(file, "JPEG", quality=88)
    picture = b64encode(file.getvalue()).decode()
    return f'<p>{words}</p><img alt="{words}" src="data:image/jpeg;base64,{picture}" style="max-width: 100%">'
