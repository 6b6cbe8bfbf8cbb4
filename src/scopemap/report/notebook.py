"""How a `Reconstruction` shows itself: in one line with its verdict, and in a notebook by its summary picture."""

from __future__ import annotations

import html
from base64 import b64encode
from io import BytesIO

from scopemap.reconstruction import VIEWS, Reconstruction
from scopemap.report.kept_run import run_of
from scopemap.report.page_data import shown_meshes
from scopemap.report.summary_picture import summary_picture
from scopemap.report.verdict import verdict

_SHOWN_FACES = 100_000


class VerdictView:
    """A `ResultView` by the verdict and the summary picture of the report."""

    def sentence(self, result: Reconstruction) -> str:
        """Return the verdict and the main facts."""
        found = verdict(run_of(result))
        return f"<Reconstruction, {found.word}: {found.sentence}>"

    def html(self, result: Reconstruction) -> str:
        """Return the summary picture."""
        run, file = run_of(result), BytesIO()
        summary_picture(run, shown_meshes(run, _SHOWN_FACES)).save(file, "JPEG", quality=88)
        picture, words = b64encode(file.getvalue()).decode(), html.escape(self.sentence(result))
        return f'<p>{words}</p><img alt="{words}" src="data:image/jpeg;base64,{picture}" style="max-width: 100%">'


VIEWS.append(VerdictView())
