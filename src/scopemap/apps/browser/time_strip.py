"""The strip of the time line: what became of each frame, and which segment it belongs to, in the report's colours."""

from __future__ import annotations

import html

import numpy as np

from scopemap.apps.browser.shown_result import ShownResult
from scopemap.report.sheet import rgb_of
from scopemap.report.summary_picture import TONES
from scopemap.result.frame_table import ROTATED
from scopemap.result.wording import LEVEL_WORDS

_SIZE = (18, 1440)
_CURSOR_PX = 5
_IN_RESULT = "in the result"
_COLOURS = {
    _IN_RESULT: "#2a9d6f",
    **{f"segment, {word}": TONES[level] for level, word in LEVEL_WORDS.items()},
    "in another submap": "#4f86dc",
    "rotation only": "#d9a514",
    "lost": "#d64545",
}
"""Of `page.css`."""


class TimeStrip:
    """The strip of a result: a picture of it, and what its colours mean."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown, frames = shown, shown.whole.frames.only(np.array(shown.rows, int))
        self._kinds: list[str] = []
        self._borders: list[int] = []
        levels, last = [one.level for one in shown.whole.segments], -1
        for submap, segment in zip(frames.submap.tolist(), frames["segment"].tolist(), strict=True):
            kind = "rotation only" if submap == ROTATED else "lost" if submap < 0 else "in another submap"
            if submap == 0:
                kind = f"segment, {LEVEL_WORDS[levels[segment]]}" if 0 <= segment < len(levels) > 1 else _IN_RESULT
                if last >= 0 and segment != last:
                    self._borders.append(len(self._kinds))
                last = segment
            self._kinds.append(kind)

    @property
    def legend(self) -> str:
        """The colours that occur, as HTML in one line."""
        box = '<span style="display:inline-block;width:11px;height:11px;margin:0 5px 0 12px;background:'
        boxes = [
            f'{box}{colour}"></span>{html.escape(kind)}' for kind, colour in _COLOURS.items() if kind in self._kinds
        ]
        return f'<div style="font-size:12px;line-height:1">{"".join(boxes)}</div>'

    def picture(self) -> np.ndarray:
        """Return the strip, (18, 1440, 3) uint8, with a dark line at the frame that is shown; segments are apart."""
        height, width = _SIZE
        place = np.arange(width) * max(len(self._kinds), 1) // width
        colours = np.array([rgb_of(_COLOURS[kind]) for kind in self._kinds] or [(200, 200, 200)], np.uint8)
        out = np.repeat(colours[place][None], height, axis=0)
        for border in self._borders:
            at = border * width // len(self._kinds)
            out[:, max(at - 1, 0) : at + 2] = 255
        if self._shown.row in self._shown.rows:
            at = (2 * self._shown.rows.index(self._shown.row) + 1) * width // (2 * len(self._kinds))
            out[:, max(at - _CURSOR_PX, 0) : at + _CURSOR_PX] = 255
            out[:, max(at - _CURSOR_PX // 2, 0) : at + _CURSOR_PX // 2] = 0
        return out
